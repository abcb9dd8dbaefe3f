"""A user's servo law: it defines one method and inherits everything else."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.errors import LevelError
from rack.levels.operator import Answer, Operation
from rack.levels.servo import LawParams, Motion, SensedMotion, ServoLaw
from rack.levels.tables import Positive
from tests.levels.arms import config
from tests.levels.lockstep import Operator
from tests.levels.servo.rig import HOME, Course, ServoRig

COURSE = Course(HOME, HOME + 0.2, 1.0)


class Gains(LawParams):
    stiffness: Positive = 2500.0
    damping: Positive = 100.0


class PdLaw(ServoLaw):
    params = Gains
    settings: Gains
    scale = 1.0
    """Factor of the torque of joint 1, which a test changes."""

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        error = set_point.position - sensed.position
        slip = set_point.velocity - sensed.velocity
        gained = self.settings.stiffness * error + self.settings.damping * slip
        torque = self.terms.inertia.diagonal() * gained + self.terms.bias
        torque[1] *= self.scale
        return torque


class PartialLaw(PdLaw):
    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        return super().torques(set_point, sensed)[:4]


class LawRig(ServoRig):
    executor = PdLaw

    @property
    def law(self) -> PdLaw:
        return cast(PdLaw, self.level)


@pytest.fixture
def rig() -> LawRig:
    return LawRig(*config("puma560"))


def test_a_law_follows_its_set_points_and_continues_after_a_restart(rig: LawRig) -> None:
    rig.run(200, COURSE.at)
    rig.restart()
    rig.run(400, COURSE.at)
    assert rig.alarms(Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED) == []
    assert np.abs(rig.status.position - COURSE.goal).max() < 0.005
    assert (rig.status.holding, rig.status.stopped) == (0, 0)


def test_a_torque_that_is_nan_is_one_finding_and_braked_once(rig: LawRig) -> None:
    rig.run(100)
    rig.law.scale = np.nan
    rig.run(100)
    assert rig.status.clipped == 100
    assert rig.alarms() == [Alarm.COMMAND_INVALID, Alarm.BRAKES_CLOSED]
    assert rig.found[0].finding.subject == 1
    assert rig.status.braked
    assert "torque of 'j2' is not finite" in rig.status.reason
    rig.law.scale = 1.0
    rig.run(100)
    assert rig.alarms()[2:] == [Alarm.BRAKES_OPENED]
    assert (rig.status.braked, rig.status.clipped) == (0, 100)


def test_a_torque_beyond_its_limit_is_cut_and_counted(rig: LawRig) -> None:
    rig.run(100)
    rig.law.scale = 1e4
    rig.run(1)
    assert rig.status.clipped >= 1
    assert abs(rig.status.torque[1]) <= rig.servo.cell.bounds.torque[1]
    assert Alarm.COMMAND_LIMIT not in rig.alarms()


def test_a_law_holds_for_its_operator_and_opens_its_gripper(rig: LawRig) -> None:
    operator = Operator(rig.rack)
    rig.run(100, COURSE.at)
    operator.say("servo", Operation.HOLD)
    rig.run(200, COURSE.at)
    assert (rig.status.answer, rig.status.standing) == (Answer.DONE, Operation.HOLD)
    assert np.abs(rig.status.velocity).max() < 5e-3
    assert rig.status.opening == pytest.approx(0.04, abs=0.002)


def test_torques_of_another_shape_are_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LawRig, "executor", PartialLaw)
    rig = LawRig(*config("puma560"))
    with pytest.raises(LevelError, match=r"class PartialLaw: torques\(\) returned shape \(4,\)"):
        rig.run(10)
