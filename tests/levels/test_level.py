"""The public API of a level's author."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import cast

import pytest

import rack.levels
from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.levels.errors import LevelError
from rack.levels.level import OPERATOR_PORT, Executor, Input, LevelContext, Output
from rack.levels.operator import Answer, AnsweringStatus, Operation, OperatorCommand
from rack.levels.tables import Finite, Live, Positive, Table


class Gains(Table):
    gain: Live[Positive] = 2.0
    """of the loop [1/s]"""
    offset: Finite = 0.0
    """of the sensor [rad]"""


class Tuned(Executor):
    """Has a live parameter."""

    params = Gains
    settings: Gains

    def process(self, tick: int) -> None:
        """Do nothing."""


class AnswerStatus(AnsweringStatus, version=1):
    """Confirms what is set."""


class Answering(Tuned):
    """Has a status that answers."""

    status = Output(AnswerStatus)


class Commanding(Tuned):
    """Reads its operator's commands itself."""

    operator = Input(OperatorCommand, "own.operator")


def test_every_export_exists_once() -> None:
    names = rack.levels.__all__
    assert len(names) == len(set(names))
    assert all(hasattr(rack.levels, name) for name in names)


def test_the_public_api_does_not_import_mujoco() -> None:
    # It takes half a second; every command of the host side imports this package.
    code = "import sys, rack.levels; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == 0


@pytest.fixture
def level() -> Answering:
    context = cast(LevelContext, SimpleNamespace(sizes={}, params={"offset": 0.5}))
    made = Answering(context)
    made.store_output("status", AnswerStatus.zeros({}))
    return made


def operator_reading(serial: int, setting: str) -> Reading[OperatorCommand]:
    message = OperatorCommand.zeros({})
    message.id = serial
    message.what = Operation.SET
    message.name = setting
    return Reading(message, Verdict.NEW)


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ("gain=3.5", ""),
        ("gain=-1", "params.gain = -1: input should be greater than 0; keys: gain, offset"),
        ("gain='a'", "params.gain = 'a': input should be a valid number; keys: gain, offset"),
        ("offset=1.0", "params.offset is not live; live: gain"),
        ("gian=1.0", "params.gian is not live; live: gain"),
    ],
)
def test_a_board_sets_a_live_parameter_only_within_its_range(
    level: Answering, setting: str, why: str
) -> None:
    level.find_input_table("operator")["operator"] = operator_reading(1, setting)
    level.take_settings(0)
    assert (level.settings.gain, level.settings.offset) == (2.0 if why else 3.5, 0.5)
    status = level.status
    assert (status.order, status.answer) == (1, Answer.REFUSED if why else Answer.DONE)
    assert status.objection == why


def test_a_level_that_reads_its_operators_commands_itself_is_not_set_by_its_board() -> None:
    assert Tuned.inputs["operator"] is Answering.inputs["operator"] is OPERATOR_PORT
    assert Answering.commands == {Operation.SET: ()}
    assert Commanding.inputs["operator"] is Commanding.operator


def test_an_attribute_may_not_have_the_name_of_the_port_that_sets_live_parameters() -> None:
    with pytest.raises(LevelError, match="class Mistaken: attribute 'operator' has the name of"):
        type("Mistaken", (Executor,), {"params": Gains, "operator": 3})
