"""Faults between servo level and arm: effect, joint, and repetition with the same seed."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from rack.boards.faults import KINDS
from rack.levels.arm import SimulatedArm
from rack.levels.arm.faulty import FaultyLink
from rack.levels.level import Fault
from rack.levels.robot.dynamics import Dynamics
from tests.levels.arms import CLOCK_NS, cell, config


def build_link(
    *faults: Fault, holds: Callable[[], bool] = bool
) -> tuple[FaultyLink, SimulatedArm, dict[int, bool]]:
    arm, acted = SimulatedArm(cell("puma560"), config("puma560")[1], CLOCK_NS), dict[int, bool]()
    link = FaultyLink(arm, acted, arm, holds)
    link.inject(faults)
    return link, arm, acted


def build_fault(kind: str, **parameters: float) -> Fault:
    return Fault(kind, parameters, 7, 0, KINDS[kind].step)


HOLDING = Dynamics(cell("puma560")).terms(cell("puma560").home, np.zeros(6)).bias.copy()


def test_a_sensor_fault_affects_only_its_joint() -> None:
    link, arm, acted = build_link(build_fault("sensor-bias", size=0.3, joint=2))
    assert link.sense().position - arm.sense().position == pytest.approx([0, 0, 0.3, 0, 0, 0])
    assert acted == {0: True}
    # An arm may lack the joint.
    faults = build_fault("sensor-nan", joint=9), build_fault("actuator-off", joint=9)
    link, arm, acted = build_link(*faults)
    assert np.array_equal(link.sense().position, arm.sense().position)
    link.drive(HOLDING, 0.0)
    assert acted == {}
    link, _, _ = build_link(build_fault("sensor-nan", joint=-1))
    sample = link.sense()
    assert np.isnan(sample.position).all()
    assert np.isfinite(sample.velocity).all()


def test_a_stuck_sensor_acts_when_wrong_and_must_be_detected_when_far_off() -> None:
    link, arm, acted = build_link(build_fault("sensor-stuck", joint=0))
    first = link.sense().position.copy()
    assert acted == {}
    shows = []
    torque = HOLDING + np.array([8.0, 0, 0, 0, 0, 0])
    for _ in range(20):
        link.drive(torque, 0.0)
        arm.step(1)
        sample = link.sense()
        assert sample.position[0] == first[0]
        shows.append(acted.pop(0))
    assert arm.sense().position[0] > first[0] + 1e-4
    assert sample.position[1] == arm.sense().position[1]
    assert shows == sorted(shows)
    assert 0 < sum(shows) < len(shows) == 20


def test_a_motor_that_is_off_gives_no_torque_and_the_others_follow_their_command() -> None:
    link, arm, acted = build_link(build_fault("actuator-off", joint=1))
    link.drive(HOLDING, 0.0)
    given = arm._data.ctrl[arm.cell.actuators]
    assert given[1] == 0.0
    assert given[2] == HOLDING[2]
    assert arm.torque[1] == HOLDING[1]  # the servo level does not know
    assert acted == {0: True}
    link.inject([])
    link.drive(HOLDING, 0.0)
    assert arm._data.ctrl[arm.cell.actuators][1] == HOLDING[1]


def test_a_saturated_motor_is_limited_and_acts_only_beyond_its_limit() -> None:
    link, arm, acted = build_link(build_fault("actuator-saturated", part=0.1, joint=-1))
    link.drive(HOLDING, 0.0)
    limits = arm.cell.bounds.torque
    assert (np.abs(arm._data.ctrl[arm.cell.actuators]) <= 0.1 * limits + 1e-12).all()
    acted.clear()
    link.drive(0.05 * limits, 0.0)
    assert acted == {}


def test_faults_on_one_arm_combine_and_each_is_recorded() -> None:
    link, arm, acted = build_link(
        build_fault("sensor-bias", size=0.1, joint=0),
        build_fault("command-nan", joint=0),
        build_fault("sensor-bias", size=0.2, joint=0),
    )
    assert (link.sense().position - arm.sense().position)[0] == pytest.approx(0.3)
    link.drive(HOLDING, 0.0)
    assert list(acted) == [0, 2, 1]


@pytest.mark.parametrize("says_held", [False, True])
@pytest.mark.parametrize(
    ("blocks", "more", "is_shown"),
    [(0, 0.0, True), (1, 0.0, False), (1, 20.0, True), (2, 20.0, False)],
)
def test_a_dead_motor_shows_later_under_a_load(
    blocks: int, more: float, is_shown: bool, says_held: bool
) -> None:
    link, arm, acted = build_link(build_fault("actuator-off", joint=1), holds=lambda: says_held)
    lay_against_a_finger(arm, blocks)
    assert (arm.is_holding_object, arm.is_touching_surroundings) == (blocks > 0, blocks > 1)
    link.drive(HOLDING + np.array([0.0, more, 0.0, 0.0, 0.0, 0.0]), 0.0)
    # Its level may take a part for held that the arm does not hold.
    assert acted == {0: is_shown and (blocks > 0 or not says_held)}


def lay_against_a_finger(arm: SimulatedArm, blocks: int) -> None:
    """Put a block where one finger is, so that it is held, and another that touches the first."""
    made, data = arm.cell, arm._data
    mujoco.mj_forward(made.model, data)
    names = {made.model.geom(int(geom)).name: int(geom) for geom in made.geoms.gripper}
    finger = next(geom for name, geom in names.items() if name.startswith("pad"))
    place = data.geom_xpos[finger].copy()
    for nth, body in enumerate(made.bodies[:blocks]):
        address = made.model.jnt_qposadr[made.model.body_jntadr[body]]
        data.qpos[address : address + 3] = place + np.array([0.049 * nth, 0.0, 0.0])
    mujoco.mj_forward(made.model, data)
