"""Boards with several neighbours, as real processes: one command read by many, many statuses read
by one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import build_rack_timing, resolve_layout
from rack.boards.config.schema import RackConfig
from rack.boards.crate.recovery import RestartPolicy
from rack.boards.timing.command_path import find_command_paths
from rack.boards.timing.system_response import find_path_mailboxes
from tests.boards.config.mistakes import find_mistake, find_mistakes
from tests.boards.conftest import MakeConfig
from tests.boards.messages import Written
from tests.boards.runs import faulty, kill
from tests.boards.vector_racks import JOINTED

SECONDS, TICKS = 0.5, 200


@pytest.fixture
def jointed(config: MakeConfig) -> MakeConfig:
    """The rack of a board a joint, with settings."""
    return lambda *settings: config(*settings, text=JOINTED)


def run(config: RackConfig, *faults: dict[str, Any]) -> tuple[str, Written]:
    """Run the rack; return its digest and everything that it wrote."""
    with Rack(faulty(config, *faults)) as rack:
        return rack.run(SECONDS).digest, Written.on(rack.segment)


def at(rows: np.ndarray, tick: int) -> np.void:
    """Return the message of the cycle released at a tick."""
    (row,) = rows[rows["tick"] == tick]
    return row


@pytest.mark.slow
def test_the_basis_of_a_message_is_the_oldest_of_several_sources(jointed: MakeConfig) -> None:
    written = run(jointed("board.joint2.rate_hz=100"))[1].messages
    # joint1 rests on the arm's cycle one tick before its own, joint2 on that before its last cycle
    # at a multiple of 4.
    assert at(written["joint1.status"], 95)["basis"] == 94
    assert at(written["joint2.status"], 88)["basis"] == 87
    assert at(written["path.status"], 96)["basis"] == 91
    assert at(written["joint3.part"], 100)["basis"] == 88
    # The arm reads the parts of all joints; its status is new information, and rests on none.
    assert at(written["arm.status"], 100)["basis"] == 100


@pytest.mark.slow
def test_a_reader_of_many_sees_which_of_them_is_lost(jointed: MakeConfig) -> None:
    killed = jointed("supervision.lockstep_restart_s=0.2"), kill("joint2", 60)
    digest, written = run(*killed)
    assert run(*killed)[0] == digest
    for mailbox, ticks in (("arm.status", (70, 160)), ("path.status", (80, 160))):
        rows = written.messages[mailbox]
        while_lost, after = (at(rows, tick)["message"]["lost"].tolist() for tick in ticks)
        assert (while_lost, after) == ([0, 1, 0], [0, 0, 0])
    # The others go on: joint2's part is the one of its last message.
    assert at(written.messages["arm.status"], 121)["message"]["position"].tolist() == [
        112.0,
        96.0,
        336.0,
    ]


def test_boards_restart_after_all_that_are_below_them_and_wait_for_no_other(
    jointed: MakeConfig,
) -> None:
    config = jointed("board.watch={ slot = 10, rate_hz = 400, executor = 'wave_levels:Wave' }")
    supervision = RestartPolicy(config, resolve_layout(config))
    lost = ["path", "watch", "joint2", "arm", "clock"]
    rounds = []
    left = [*lost]
    while ready := supervision.list_startable(left, []):
        rounds.append(ready)
        left = [name for name in left if name not in ready]
    assert rounds == [["clock"], ["watch", "arm"], ["joint2"], ["path"]]

    def waits(name: str, absent: str) -> bool:
        return not supervision.list_startable([name], [absent])

    assert [name for name in lost if waits(name, "arm")] == ["path", "joint2"]
    assert [name for name in lost if waits(name, "joint1")] == ["path"]
    assert [name for name in lost if waits(name, "clock")] == [
        "path",
        "watch",
        "joint2",
        "arm",
    ]


def test_information_is_traced_through_the_sources_of_each_message(jointed: MakeConfig) -> None:
    config = jointed()
    layout = resolve_layout(config)

    def find_names(*boards: str) -> list[list[str]]:
        """Return the names of the mailboxes of each row along the boards."""
        return [[box.name for box in row] for row in find_path_mailboxes(layout, boards)]

    assert find_names("path", "joint2", "arm") == [["path.command", "joint2.part"]]
    assert find_names("arm", "joint2", "path") == [["arm.status", "joint2.status"]]
    # Of two boards it is the one between them, of one board none.
    assert find_names("joint2", "arm") == [["joint2.part"]]
    assert find_names("arm") == [[]]
    assert find_command_paths(build_rack_timing(config, layout), layout)["path"].cycles == (8, 1, 1)


CIRCLES = {
    "through many": ("board.arm.below=path", "board.arm.below", "path -> joint1 -> arm -> path"),
    "two tables disagree": ("board.arm.below=joint3", "board.arm.below", "arm -> joint3 -> arm"),
}


@pytest.mark.parametrize(("setting", "place", "circle"), CIRCLES.values(), ids=CIRCLES)
def test_a_circle_is_one_mistake_with_its_members(setting: str, place: str, circle: str) -> None:
    found = find_mistakes(JOINTED, setting)
    (mistake,) = [mistake for mistake in found if "circle" in str(mistake)]
    assert mistake.place == place
    assert str(mistake).endswith(f"the levels form a circle, {circle}")


WRONG = {
    "twice": (
        "board.path.below=['joint1', 'joint1']",
        'board.path.below = "joint1": listed 2 times',
    ),
    "itself": (
        "board.path.below=['joint1', 'path']",
        'board.path.below = "path": no other board has this name',
    ),
    "unknown": (
        "board.path.below=['joint1', 'j2']",
        'board.path.below = "j2": no other board has this name; boards: ',
    ),
    "many for one port": (
        "board.joint1.reads.above=['path.command', 'joint2.part']",
        "port 'above' of the executor reads one mailbox, not 2",
    ),
    "rests on no input": (
        "board.joint1.executor=vector_levels:Misled",
        "its output 'part' rests on 'parts'; inputs: above, below",
    ),
}


@pytest.mark.parametrize(("setting", "expected"), WRONG.values(), ids=WRONG)
def test_a_wrong_list_is_one_mistake(setting: str, expected: str) -> None:
    assert expected in find_mistake(JOINTED, setting)
