"""Something hits the arm: it is named as a collision, by geoms, and neither motor nor sensor is blamed for it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.levels.messages import Error
from rack.levels.scene import MotionConfig
from tests.levels.arms import config
from tests.levels.servo_rig import ServoRig

Array = NDArray[np.float64]

BRAKES = (Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED)
ROBOT, SCENE = config("puma560_crossing")
HOME = np.array(ROBOT.home)
FOREARM, HAND = (0.35, 1.3), (0.5, 1.1)
"""x and z, m, at which the post meets them on its way in y."""


def turn(time_s: float) -> tuple[Array, Array]:
    """Turn about the base, back and forth."""
    base = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return HOME + 0.6 * base * (1.0 - np.cos(2.0 * time_s)), 1.2 * base * np.sin(2.0 * time_s)


def stand(_: float) -> tuple[Array, Array]:
    """Stay at home."""
    return HOME, np.zeros(6)


def under_fire(at: tuple[float, float], end_y: float, speed: float) -> ServoRig:
    """Return an arm towards which the post comes, from second 0.4 on."""
    (x, z), begin_y = at, 0.85
    motion = (
        MotionConfig(body="post", at=0.0, to=(x, begin_y, z), speed=50.0),
        MotionConfig(body="post", at=0.4, to=(x, end_y, z), speed=speed),
    )
    return ServoRig(ROBOT, SCENE.model_copy(update={"motion": motion}), patience=1.0)


@pytest.mark.parametrize("motion", [stand, turn])
@pytest.mark.parametrize("at", [FOREARM, HAND])
def test_a_blow_at_4_m_s_is_a_collision_and_no_fault_of_motor_or_sensor_nor_a_broken_limit(
    at: tuple[float, float], motion: type
) -> None:
    rig = under_fire(at, -0.85, 4.0)
    rig.run(300, motion)
    (found,) = (f for f in rig.found if f.finding.alarm not in BRAKES)
    assert found.finding.alarm is Alarm.COLLISION
    names = {rig.servo.arm._model.geom(int(g)).name for g in found.finding[1:]}  # type: ignore[attr-defined]
    assert "post" in names
    assert (rig.status.state, rig.status.braked) == (State.HOLDING, 1)
    assert "'post'" in rig.status.reason
    assert rig.status.violations == 0
    assert rig.status.pushed > 0
    rig.run(400, motion)
    assert (rig.status.stopped, rig.status.braked, rig.status.state) == (0, 0, State.EXECUTING)
    assert [f.finding.alarm for f in rig.found if f.finding.alarm not in BRAKES] == [Alarm.COLLISION]


def test_a_contact_that_stays_is_latched_with_what_touches_what() -> None:
    rig = under_fire(HAND, 0.2, 4.0)
    rig.run(1200, turn)
    assert (rig.status.state, rig.status.error, rig.status.braked) == (State.ERROR, Error.TOUCHED, 1)
    assert rig.status.reason.startswith("unintended contact: '")
    assert "'post'" in rig.status.reason
    assert {f.finding.alarm for f in rig.found if f.finding.alarm not in BRAKES} == {Alarm.COLLISION, Alarm.LATCHED}


def test_a_limit_that_the_arm_itself_breaks_is_a_violation_with_or_without_a_blow() -> None:
    rig = under_fire(FOREARM, -0.85, 4.0)
    rig.run(200, stand)
    arm = rig.servo.arm
    arm._data.qvel[arm._cell.dof[1]] = 3.0  # type: ignore[attr-defined]
    rig.run(1, stand)
    assert rig.status.violations > 0
    assert rig.status.pushed == 0
    assert rig.status.error == Error.LIMIT
