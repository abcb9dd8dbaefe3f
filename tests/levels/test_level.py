"""The public API of a level's author."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any, cast

import pytest

import rack.levels
from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, field
from rack.backplane.watch.alarms import Alarm
from rack.levels.errors import LevelError
from rack.levels.level import (
    OPERATOR_PORT,
    Executor,
    Finding,
    FindingKind,
    Input,
    Inputs,
    LevelContext,
    Output,
    QueuedOutput,
)
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
def test_a_live_parameter_is_set_within_its_range(setting: str, why: str) -> None:
    level = Answering(cast(LevelContext, SimpleNamespace(sizes={}, params={"offset": 0.5})))
    level.store_output("status", AnswerStatus.zeros({}))
    message = OperatorCommand.zeros({})
    message.id, message.what, message.name = 1, Operation.SET, setting
    level.find_input_table("operator")["operator"] = Reading(message, Verdict.NEW)
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


CONTEXT = cast(LevelContext, SimpleNamespace(sizes={}, params={}))


class Feeler(Executor):
    """Finds what it is told to find."""

    contact = FindingKind(unit="N m", doc="the arm touches something")
    worn = FindingKind(unit="1", doc="a joint is worn")

    def process(self, tick: int) -> None:
        """Find nothing."""


class FinerFeeler(Feeler):
    """Finds more, and forgets wear."""

    worn = None  # type: ignore[assignment]
    warm = FindingKind(unit="K", doc="a motor is warm")


def test_a_finding_has_the_number_of_its_declaration() -> None:
    level = FinerFeeler(CONTEXT)
    level.raise_finding("warm", 41.5, unit="K", text="elbow")
    level.raise_finding("contact", value=3.2)
    assert [*FinerFeeler.finding_kinds] == ["contact", "warm"]
    warm, contact = Finding(Alarm.OWN, 1, 41.5, text="elbow"), Finding(Alarm.OWN, 0, 3.2)
    assert level.findings == [warm, contact]


@pytest.mark.parametrize(
    ("name", "unit", "why"),
    [
        ("contct", "", "finding 'contct' is not declared; did you mean 'contact'[?]"),
        ("x", "", "finding 'x' is not declared; declared: contact, worn"),
        ("contact", "N", "finding 'contact' is in N m, not in N"),
    ],
)
def test_an_undeclared_finding_is_refused(name: str, unit: str, why: str) -> None:
    with pytest.raises(LevelError, match=f"class Feeler: {why}"):
        Feeler(CONTEXT).raise_finding(name, 1.0, unit=unit)


@pytest.mark.parametrize(
    ("attributes", "why"),
    [
        ({"hot": FindingKind(unit="", doc="hot")}, "finding 'hot' needs a unit"),
        ({"hot": FindingKind(unit="K", doc="")}, "finding 'hot' needs a unit"),
        ({"hang": FindingKind(unit="1", doc="hangs")}, "finding 'hang' has the name of another"),
        ({"died": FindingKind(unit="1", doc="ended")}, "finding 'died' has the name of another"),
        ({"params": FindingKind(unit="1", doc="x")}, "finding 'params' has the name of another"),
        ({"contact": 3}, "attribute 'contact' has the name of a finding"),
    ],
)
def test_an_invalid_declaration_is_an_error(attributes: dict[str, Any], why: str) -> None:
    with pytest.raises(LevelError, match=f"class Mistaken: {why}"):
        type("Mistaken", (Feeler,), attributes)


class Number(Message, version=1):
    """A number."""

    value: int = field(unit="1", doc="")


class Base(Executor):
    """Reads two ports, writes one."""

    above = Input(Number, "above.number")
    below = Inputs(Number, "below.number", optional=True)
    number = Output(Number, rests_on=above)

    def process(self, tick: int) -> None:
        """Hand the number on."""
        self.number.value = self.above.message.value


def test_a_class_has_the_ports_of_its_bases_then_its_own() -> None:
    class Derived(Base):
        below = None  # type: ignore[assignment]
        more = Input(Number, "own.number")
        last = QueuedOutput(Number)

    assert [*Base.inputs] == ["above", "below"]
    assert [*Derived.inputs] == ["above", "more"]
    assert [*Derived.outputs] == ["number", "last"]
    assert Derived.outputs["number"].rests_on is Base.above
    assert (Derived.last.queued, Base.below.many, Base.below.optional) == (True, True, True)


def test_a_level_without_a_board_has_empty_readings_and_messages() -> None:
    level = Base(CONTEXT)
    assert (level.above.verdict, level.above.message.value, level.below) == (Verdict.NONE, 0, {})
    number = Number.zeros({})
    number.value = 5
    level.find_input_table("above")["above"] = Reading(number, Verdict.NEW)
    level.process(0)
    assert level.number.value == 5
    assert Base(CONTEXT).number.value == 0


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ({"context": Input(Number, "a.b")}, ""),
        ({"inputs": {"a": Input(Number, "a.b")}}, "'inputs' is no longer a dict"),
        ({"process": Input(Number, "a.b")}, "port 'process' has the name of another attribute"),
        ({"params": Output(Number)}, "port 'params' has the name of another attribute"),
        ({"above": 3}, "attribute 'above' has the name of a port"),
        ({"number": lambda self: None}, "attribute 'number' has the name of a port"),
    ],
)
def test_a_port_named_like_an_attribute_is_an_error(body: dict[str, Any], why: str) -> None:
    if not why:
        # The constructor sets it: that is found when a board connects the port.
        level = type("Bad", (Base,), body)(CONTEXT)
        with pytest.raises(LevelError, match="class Bad: attribute 'context' has the name of a"):
            level.find_input_table("context")
        return
    with pytest.raises(LevelError, match=f"^class Bad: {why}"):
        type("Bad", (Base,), body)


def test_ports_from_a_config_are_separate_from_attributes() -> None:
    level = Base(CONTEXT)
    level.find_input_table("context")["context"] = 1
    level.store_output("process", 2)
    assert level.ports == {"context": 1, "process": 2}
    assert level.context is CONTEXT


def test_an_unconnected_level_cannot_send() -> None:
    class Sending(Base):
        letters = QueuedOutput(Number)

    with pytest.raises(LevelError, match="port 'letters': no board has connected it"):
        _ = Sending(CONTEXT).letters
