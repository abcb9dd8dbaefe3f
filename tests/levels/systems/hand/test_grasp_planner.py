"""Planned grasps: tips on opposite sides of the object, joints that reach them, and no contact
before they close."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.algebra import Array, mat_vec
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.workstation import GraspPlanner, GraspRules, PlannedGrasp
from tests.levels.arms import cell

HAND = cell("utah_mit")
CAN_RADIUS_M = 0.024
RULES = GraspRules()
START = HAND.build_start_data()
AT, UPRIGHT = START.xpos[HAND.bodies[0]].copy(), np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def planner() -> GraspPlanner:
    return GraspPlanner(HAND, "thumb", RULES)


@pytest.fixture(scope="module")
def planned(planner: GraspPlanner) -> PlannedGrasp:
    found = planner.plan(0, AT, UPRIGHT)
    assert found is not None
    return found


def tips(posture: Array) -> Array:
    """Return the tips at joint positions, (fingers, 3), m, in the palm's frame."""
    assert HAND.hand is not None
    kinematics = FingerKinematics(HAND, HAND.hand)
    kinematics.set_position(posture)
    return np.array([kinematics.find_tip(finger) for finger in range(4)])


@pytest.mark.slow
def test_fingers_and_thumb_press_on_opposite_sides_of_the_surface(planned: PlannedGrasp) -> None:
    found = planned
    radii = np.sqrt((found.contact[:, :2] ** 2).sum(axis=1))
    assert radii == pytest.approx(np.full(4, CAN_RADIUS_M))
    assert found.normal[:3] == pytest.approx(-found.normal[[3, 3, 3]])
    # Each pushes into the object, through its axis.
    assert found.normal[:, :2] == pytest.approx(-found.contact[:, :2] / CAN_RADIUS_M)
    assert 0.1 < found.margin < 0.5
    # They close from tips that are clear of the object by as much as asked.
    outside = AT + found.contact - RULES.clear * found.normal
    palm = START.site_xmat[HAND.tool].reshape(3, 3).T
    wanted = np.array([mat_vec(palm, point - START.site_xpos[HAND.tool]) for point in outside])
    assert np.abs(tips(found.posture) - wanted).max() < 2e-3


@pytest.mark.slow
def test_the_grip_bears_weight_and_pull_by_friction_with_a_reserve() -> None:
    found = GraspPlanner(HAND, "thumb", GraspRules(pull=4.0, reserve=2.0)).plan(0, AT, UPRIGHT)
    assert found is not None
    # 0.15 kg, friction 1, three fingers that press and a thumb that bears their sum.
    assert 2.0 * 3.0 * found.grip == pytest.approx(2.0 * (0.15 * 9.81 + 4.0))
