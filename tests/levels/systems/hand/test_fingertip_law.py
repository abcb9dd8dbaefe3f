"""Kinematics of the fingers, and joint targets for postures, points and forces."""

from __future__ import annotations

import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.laws import FingertipGains, FingertipLaw
from rack.levels.systems.hand.messages import FingerMode, FingerTarget, GraspTarget
from tests.levels.arms import cell

HAND = cell("utah_mit")
SIZES = {"joints": 16, "fingers": 4}
PERIOD_S = 0.008
BENT = np.radians([0.0, 35.0, 40.0, 35.0] * 3 + [0.0, 5.0, 50.0, 55.0])
FINGER = 1


def the_kinematics() -> FingerKinematics:
    assert HAND.hand is not None
    return FingerKinematics(HAND, HAND.hand)


class Tips:
    """The law of all fingers. Joints are always at their targets, unless `sensed` is set."""

    def __init__(self) -> None:
        self.law = FingertipLaw(the_kinematics(), range(4), FingertipGains(), PERIOD_S)
        self.law.start(BENT)
        self.grasp, self.target = GraspTarget.zeros(SIZES), FingerTarget.zeros(SIZES)
        self.grasp.position = BENT

    def run(self, cycles: int, sensed: Array | None = None) -> Array:
        for _ in range(cycles):
            tips = self.law.find_tips(self.law.wanted if sensed is None else sensed)
            self.law.set_targets(self.grasp, 0.0, self.target)
        return tips.copy()


def test_the_jacobian_is_the_derivative_of_the_tip() -> None:
    kinematics, step = the_kinematics(), 1e-6
    kinematics.set_position(BENT)
    for finger, own in enumerate(kinematics.joints):
        kinematics.set_position(BENT)
        jacobian, tip = kinematics.find_jacobian(finger), kinematics.find_tip(finger)
        for column, joint in enumerate(own):
            moved = BENT.copy()
            moved[joint] += step
            kinematics.set_position(moved)
            change = (kinematics.find_tip(finger) - tip) / step
            assert change == pytest.approx(jacobian[:, column], abs=1e-5)


def test_a_tip_comes_to_its_point_evenly_and_other_fingers_keep_their_posture() -> None:
    tips = Tips()
    start = tips.run(1)
    tips.grasp.mode[FINGER] = FingerMode.POINT
    tips.grasp.tip[FINGER] = start[FINGER] + (0.005, 0.004, -0.006)
    speeds = []
    for _ in range(12):
        tips.run(1)
        speeds.append(np.abs(tips.target.velocity).max())
    assert tips.run(1)[FINGER] == pytest.approx(tips.grasp.tip[FINGER], abs=2e-4)
    assert max(speeds) <= HAND.limits.velocity.max()
    assert speeds[-1] < 0.2
    others = np.delete(np.arange(16), the_kinematics().joints[FINGER])
    assert tips.target.position[others] == pytest.approx(BENT[others])
    # A point out of reach keeps the joints within their limits.
    tips.grasp.tip[FINGER] = start[FINGER] + (0.3, 0.0, -0.3)
    tips.run(200)
    low, high = HAND.limits.position.T
    assert (tips.target.position >= low).all()
    assert (tips.target.position <= high).all()


def test_torques_of_a_force_do_its_work() -> None:
    tips = Tips()
    start = tips.run(1, BENT)
    tips.grasp.mode[FINGER], tips.grasp.tip[FINGER] = FingerMode.FORCE, start[FINGER]
    tips.grasp.force[FINGER] = (1.0, -2.0, 3.0)
    tips.run(1, BENT)
    kinematics, small = the_kinematics(), 1e-6 * np.arange(16)
    kinematics.set_position(BENT + small)
    work = float(tips.grasp.force[FINGER] @ (kinematics.find_tip(FINGER) - start[FINGER]))
    assert float(tips.target.torque @ small) == pytest.approx(work, rel=1e-3)
    own = kinematics.joints[FINGER]
    assert (tips.target.stiff[own] == FingertipGains().posture).all()
    assert tips.target.torque[np.delete(np.arange(16), own)].tolist() == [0.0] * 12


def test_a_tip_that_is_pushed_away_is_a_spring_of_its_stiffness_in_all_directions() -> None:
    tips = Tips()
    start = tips.run(1, BENT)
    tips.grasp.mode[FINGER], tips.grasp.tip[FINGER] = FingerMode.FORCE, start[FINGER]
    tips.grasp.stiffness[FINGER] = 200.0
    tips.run(1, BENT)
    kinematics = the_kinematics()
    own = kinematics.joints[FINGER]
    for pushed in np.eye(4) * 1e-5:
        kinematics.set_position(BENT)
        jacobian = kinematics.find_jacobian(FINGER)
        away = np.zeros(16)
        away[own] = pushed
        kinematics.set_position(BENT + away)
        force = -200.0 * (kinematics.find_tip(FINGER) - start[FINGER])
        torque = -tips.target.spring @ away
        assert torque[own] == pytest.approx(jacobian.T @ force, rel=1e-3, abs=1e-9)
        assert np.delete(torque, own).tolist() == [0.0] * 12
