"""Parts of boards that servo joints and of the board of the arm: loads and torques."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.levels.level import Pace
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.systems.joint_boards.arm_executor import JointTorques
from rack.levels.systems.joint_boards.joint_control import AT, DUE, JointLoads
from rack.levels.systems.joint_boards.messages import JointReference, JointTorque
from tests.levels.arms import cell, config, context
from tests.levels.servo.joint_rig import CLOCK_NS, JOINTS

SIZES = {"joints": len(JOINTS)}
TICK = 100


def reference(due: int, inertia: float, load: float) -> Message:
    message = JointReference.zeros(SIZES)
    message.due, message.inertia, message.load = due, np.full(6, inertia), np.full(6, load)
    return message


def torque(sampled: int, joint: int, newton_metres: float) -> Message:
    message = JointTorque.zeros(SIZES)
    message.sampled = sampled
    message.torque[joint], message.target[joint] = newton_metres, 0.1 * joint
    message.target_velocity[joint] = 0.2
    return message


def joint_torques() -> JointTorques:
    """Return the torques of two boards, one as fast as the arm and one at half its rate."""
    robot, scene = config("puma560")
    pace = {"fast": Pace(1, 1), "slow": Pace(2, 1)}
    level = context("arm", (robot, scene), seed=0, sizes=SIZES, above=pace)
    return JointTorques(level, build_cell(robot, scene, CLOCK_NS))


def readings(fast: Message, slow: Message) -> dict[str, Reading]:
    return {"fast": Reading(fast, Verdict.NEW), "slow": Reading(slow, Verdict.OLD)}


def test_loads_are_interpolated_between_references() -> None:
    loads = JointLoads(cell("puma560"))
    loads.take_reference(reference(due=20, inertia=2.0, load=5.0), tick=0)
    loads.take_reference(reference(due=40, inertia=4.0, load=9.0), tick=20)
    begin, end = loads.table[AT], loads.table[DUE]
    assert [loads.compute_passed_part(tick) for tick in (20, 25, 40, 60)] == [0.0, 0.25, 1.0, 1.0]
    assert (begin[:, 0].tolist(), end[:, 0].tolist()) == ([2.0, 5.0], [4.0, 9.0])


def test_loads_of_a_holding_arm_are_computed_again_only_after_it_has_moved() -> None:
    puma = cell("puma560")
    loads, still = JointLoads(puma), np.zeros(6)
    loads.compute_at_rest(puma.home)
    at_home = loads.table.copy()
    expected = Dynamics(puma).terms(puma.home, still)
    assert np.array_equal(at_home[1], expected.bias)
    assert np.array_equal(at_home[0], np.diagonal(expected.inertia))
    loads.compute_at_rest(puma.home + 0.005)
    assert np.array_equal(loads.table, at_home)
    loads.compute_at_rest(puma.home + 0.02)
    assert not np.array_equal(loads.table, at_home)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("inertia", value) for value in (0.0, math.nan, math.inf, 1e308)),
        *(("load", value) for value in (math.nan, 1e3, -1e308)),
        *(("position", value) for value in (math.nan, 7.0, -1e308)),
        *(("payload_mass", value) for value in (-1.0, 100.0, 1e308)),
    ],
)
def test_a_reference_beyond_the_arm_is_named(field: str, value: float) -> None:
    puma = cell("puma560")
    loads = JointLoads(puma)
    message = reference(20, 1.0, 1.0)
    message.position = puma.home
    assert loads.find_invalid_field(message) == ""
    setattr(message, field, value)
    assert loads.find_invalid_field(message) == field


def test_torques_of_all_boards_are_added_up() -> None:
    torques, fast, slow = joint_torques(), torque(TICK - 2, 0, 7.0), torque(TICK - 3, 5, -3.0)
    slow.grip_force, slow.operator = 12.0, 4
    slow.payload_mass, slow.payload_offset = 0.3, (0.0, 0.1, 0.2)
    read = readings(fast, slow)
    assert torques.find_missing(read, TICK, since=0) == ""
    torques.sum_commands(read)
    assert torques.torque.tolist() == [7.0, 0.0, 0.0, 0.0, 0.0, -3.0]
    assert torques.wanted.position.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 0.5]
    assert (torques.moves, torques.rests_on, torques.grip_force) == (True, 4, 12.0)
    assert (torques.payload.mass, torques.payload.offset.tolist()) == (0.3, [0.0, 0.1, 0.2])


STALE = "stale torque from board 'slow': based on a status more than 7 ticks old"
MISSING: dict[str, tuple[str, Any, str]] = {
    "lost": ("is_lost", True, "board 'slow' is lost: braked until it is back"),
    "never sent": ("verdict", Verdict.NONE, "no torque from board 'slow' yet"),
    "sent before the arm's first status": ("sampled", -1, "no torque from board 'slow' yet"),
    "stale, by its own cycle": ("sampled", TICK - 8, STALE),
    "from before the brakes engaged": ("", 0, "braked until the boards above have seen it"),
}


@pytest.mark.parametrize("case", MISSING)
def test_a_missing_or_invalid_torque_is_reported_with_its_board(case: str) -> None:
    field, value, reason = MISSING[case]
    read = readings(torque(TICK - 2, 0, 7.0), torque(TICK - 3, 5, -3.0))
    if field == "sampled":
        read["slow"].message.sampled = value
    elif field:
        read["slow"] = read["slow"]._replace(**{field: value})
    since = 0 if field else TICK - 2
    assert joint_torques().find_missing(read, TICK, since) == reason
