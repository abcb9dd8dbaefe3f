"""The arm as a board of its own, in a rack of processes: refused where joints lack a board,
repeatable, and safe. Engagements of its brakes are counted with their reasons; long ones make a run
fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.boards import Rack
from rack.boards.events import NO_TORQUE
from tests.boards.config.mistakes import find_mistakes
from tests.boards.conftest import MakeConfig, format_board
from tests.boards.runs import faulty, kill
from tests.levels.arms import ROBOTS

ARM = "rack.levels.systems.joint_boards:ArmExecutor"
JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")
TOGETHER: Mapping[str, Mapping[str, Any]] = {"servo": {"gripper": True}}
APART = {f"servo_{joint}": {"joints": [joint], "gripper": joint == JOINTS[-1]} for joint in JOINTS}
"""Parameters of the boards that servo joints, by name: one for all joints, or one each."""


def arm_rack(servos: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a rack with these boards as TOML."""
    names = list(servos)
    boards = [
        format_board(
            name,
            4 + at,
            "rack.levels.systems.joint_boards:JointServo",
            core=at % 2,
            rate_hz=1000,
            above="swing",
            below="arm",
            params=params,
        )
        for at, (name, params) in enumerate(servos.items())
    ]
    return f"""
extends = ["{ROBOTS / "puma560.toml"}"]
format = 2
name = "arm"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 1.0
mode = "lockstep"

[robot]
substeps = 2

[supervision]
max_missed_fraction = 1.0
lockstep_restart_s = 0.1

{format_board("arm", 2, ARM, core=1, rate_hz=1000, above=names)}
{format_board("swing", 3, "joint_levels:Swing", rate_hz=50, below=names)}
{"".join(boards)}
"""


def named(joints: Sequence[str]) -> dict[str, Mapping[str, Any]]:
    """Return `APART` whose first board has other `joints`."""
    return APART | {"servo_j1": {"joints": list(joints)}}


KILLED_AT = 301
DEATH_BOUND = 4
"""Ticks after which no torque of a dead board counts."""

WRONG: dict[str, tuple[Mapping[str, Mapping[str, Any]], str, str]] = {
    "a joint that no board commands": (
        {name: params for name, params in APART.items() if name != "servo_j3"},
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


def stalling(**params: int) -> str:
    """Return a rack of 1 kHz whose arm's board stalls, as TOML."""
    given = ", ".join(f"{key} = {value}" for key, value in params.items())
    return arm_rack(TOGETHER).replace(
        f'"{ARM}"', f'"joint_levels:StallingArm"\nparams = {{ {given} }}'
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("stall", "count"), [(4, 0), (5, 2)])
def test_a_stall_longer_than_the_patience_is_one_braking_with_its_time(
    config: MakeConfig, stall: int, count: int
) -> None:
    with Rack(config(text=stalling(stall=stall))) as rack:
        outcome = rack.run(1.1)
    assert (outcome.faults, outcome.is_success) == ((), True)
    assert [braking.why for braking in outcome.brakings] == [NO_TORQUE] * count
    for number, braking in enumerate(outcome.brakings, 1):
        # The last torque was given in the last cycle before the stall, and the motors kept it for 5
        # cycles.
        assert braking.since == 400 * number - stall - 1 + 5
        # The boards above must see that the arm was braked before it is released.
        assert stall - 4 < braking.lasted_ms < stall - 4 + 6


HELD = "held without a known cause"


@pytest.mark.thorough
def test_a_run_held_by_brakes_has_failed_and_says_so(config: MakeConfig) -> None:
    with Rack(config(text=stalling(stall=400, period=600))) as rack:
        outcome = rack.run(0.65)
    assert (outcome.cause, outcome.is_success) == ("time over", False)
    (fault,) = outcome.faults
    assert fault.startswith(f"{HELD}, in 650 ms: brakes engaged 1 time, ")
    assert fault.endswith(" ms at tick 204: no torque (1)")
