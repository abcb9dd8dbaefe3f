"""The arm as a board of its own, in a rack of processes: refused where joints lack a board,
repeatable, and safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.boards import Rack
from tests.boards.arm_racks import APART, TOGETHER, arm_rack, named, without
from tests.boards.config.mistakes import find_mistakes
from tests.boards.conftest import MakeConfig
from tests.boards.runs import faulty, kill

KILLED_AT = 301
DEATH_BOUND = 4
"""Ticks after which no torque of a dead board counts."""

WRONG: dict[str, tuple[Mapping[str, Mapping[str, Any]], str, str]] = {
    "a joint that no board commands": (
        without("servo_j3"),
        "board.arm.above",
        "joint 'j3' must be commanded by one board; it is commanded by none",
    ),
    "a joint that two boards command": (
        named(["j1", "j4"]),
        "board.arm.above",
        "joint 'j4' must be commanded by one board; it is commanded by 'servo_j1', 'servo_j4'",
    ),
    "a gripper that no board drives": (
        {"servo": {}},
        "board.arm.above",
        "the gripper must be commanded by one board; it is commanded by none",
    ),
    "a joint that the arm lacks": (
        named(["j1", "j7"]),
        "board.servo_j1.params.joints",
        "the arm has no such joint; joints: j1, j2, j3, j4, j5, j6",
    ),
    "a board that drives nothing": (
        TOGETHER | {"idle": {"joints": []}},
        "board.idle.params.joints",
        "it drives no joint, and not the gripper",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_joints_without_one_board_are_refused_in_one_line(
    write: Callable[[str, str], Path], case: str
) -> None:
    servos, place, reason = WRONG[case]
    (mistake,) = find_mistakes(write("arm.toml", arm_rack(servos)))
    assert (mistake.place, mistake.why) == (place, reason)


@pytest.mark.thorough
@pytest.mark.slow
def test_killed_board_of_a_joint_brakes_the_arm_within_bound_and_the_run_repeats(
    config: MakeConfig,
) -> None:
    given = faulty(config(text=arm_rack(APART)), kill("servo_j3", KILLED_AT))
    digests = []
    for _ in range(2):
        with Rack(given) as rack:
            digests.append(rack.run(0.9).digest)
            braked = [event.tick for event in rack.events if event.code == "brakes_closed"]
            released = [
                event.tick
                for event in rack.events
                if event.code == "brakes_opened" and event.tick > KILLED_AT
            ]
            rejoined = [event.tick for event in rack.events if event.code == "rejoined"]
            arm = open_observer(rack.segment, "arm.status").peek().message
    assert digests[0] == digests[1]
    assert [KILLED_AT < tick <= KILLED_AT + DEATH_BOUND for tick in braked] == [True]
    assert [rejoined[0] < tick <= rejoined[0] + DEATH_BOUND for tick in released] == [True]
    assert (arm.stopped, arm.holding, arm.violations, arm.reason) == (0, 0, 0, "")


@pytest.mark.slow
def test_a_late_report_of_engaged_brakes_has_the_tick_of_the_engagement(
    config: MakeConfig,
) -> None:
    with Rack(faulty(config(text=arm_rack(TOGETHER)), kill("arm", KILLED_AT))) as rack:
        outcome = rack.run(0.6)
        events = rack.events
    (braking,) = (event for event in events if event.code == "brakes_closed" and event.value)
    (rejoined,) = (event for event in events if event.code == "rejoined")
    assert KILLED_AT < braking.tick == braking.since <= KILLED_AT + 10 < rejoined.tick
    assert braking.text.endswith(f"known at tick {rejoined.tick}")
    assert braking.tick in [one.since for one in outcome.brakings]
    assert [event.text for event in events if event.code == "mute"] == []
