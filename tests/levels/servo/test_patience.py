"""Every fault of the arm ends within its bound: recovered in time or latched."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.algebra import Array
from rack.levels.messages import Error
from tests.levels.arms import config
from tests.levels.servo.rig import ServoRig

ROBOT, SCENE = config("puma560")
HOME = np.array(ROBOT.home)
SWING = np.array([0.25, -0.2, 0.25, 0.4, 0.4, 0.4])
OMEGA = 2.0 * math.pi / 1.2
PATIENCE_TICKS = 120
WITHIN = {"patience": PATIENCE_TICKS * 0.0025, "retry": 0.05}
RECOVERS_TICKS = 75
"""Ticks of a retry, the good cycles after it, and the rest of the last try."""
KINDS = [
    ("sensor-nan", {}, Error.SENSORS),
    ("sensor-stuck", {}, Error.SENSORS),
    ("sensor-dropout", {}, Error.SENSORS),
    ("sensor-bias", {"size": 0.02}, Error.SENSORS),
    ("sensor-bias", {"size": -0.002}, Error.SENSORS),
    ("sensor-noise", {"size": 0.005}, Error.SENSORS),
    ("actuator-off", {}, Error.MOTORS),
    ("actuator-saturated", {"part": 0.01}, Error.MOTORS),
    ("command-nan", {}, Error.LIMIT),
    ("command-limit", {"factor": 5.0}, Error.LIMIT),
]


def swing(time_s: float) -> tuple[Array, Array]:
    """Move every joint back and forth, from rest."""
    angle = OMEGA * time_s
    return HOME + 0.5 * SWING * (1.0 - math.cos(angle)), 0.5 * SWING * OMEGA * math.sin(angle)


def follows(rig: ServoRig) -> bool:
    return rig.status.state == State.EXECUTING and not rig.status.stopped and not rig.status.reason


def swinging(**params: float) -> ServoRig:
    rig = ServoRig(ROBOT, SCENE, **(WITHIN | params))
    rig.run(60, swing)
    assert follows(rig)
    return rig


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "parameters", "error"), KINDS)
def test_a_fault_that_ends_in_time_is_recovered_from_within_its_bound(
    kind: str, parameters: dict[str, float], error: Error
) -> None:
    rig = swinging()
    for joint in range(-1, 6):
        rig.inject(kind, joint=joint, **parameters)
        rig.run(25, swing)
        rig.heal()
        waited = 0
        while not follows(rig) or rig.servo.sensors.faulty:
            rig.run(1, swing)
            waited += 1
            assert waited <= RECOVERS_TICKS, (joint, rig.status.reason)
        rig.run(50, swing)
        assert follows(rig)
        assert rig.status.target == pytest.approx(rig.servo.arm.sense().position, abs=3e-3)
    assert (rig.status.violations, rig.status.error) == (0, Error.NONE)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(KINDS)))
def test_a_fault_that_outlasts_the_patience_is_latched_with_its_cause(number: int) -> None:
    (kind, parameters, error), joint = KINDS[number], number % 6
    rig = swinging()
    rig.inject(kind, joint=joint, **parameters)
    ticks = 0
    while rig.status.state != State.ERROR:
        rig.run(1, swing)
        ticks += 1
        # A motor is missed only once its torque is needed, and follows between two tries.
        assert ticks <= 4 * PATIENCE_TICKS, rig.status.reason
        assert follows(rig) or rig.status.reason
    assert rig.status.error == error
    assert rig.status.reason.endswith("; not over within 0.3 s")
    if kind != "sensor-dropout":
        assert f"'j{joint + 1}'" in rig.status.reason
        latched = next(f.finding for f in rig.found if f.finding.alarm is Alarm.LATCHED)
        assert latched.subject == joint
    rig.heal()
    rig.run(100, swing)
    assert (rig.status.state, rig.status.braked) == (State.ERROR, 1)


def test_a_latched_fault_outlasts_a_restart_of_the_board() -> None:
    rig = swinging()
    rig.inject("sensor-nan", joint=1)
    rig.run(2 * PATIENCE_TICKS, swing)
    reason = rig.status.reason
    rig.heal()
    rig.restart()
    rig.run(60, swing)
    status = rig.status
    assert (status.state, status.error, status.reason) == (State.ERROR, Error.SENSORS, reason)


def test_a_demand_on_the_arm_is_the_reason_and_does_not_use_up_patience() -> None:
    rig = swinging()
    rig.inject("sensor-nan", joint=1)
    rig.rack.demand = Demand.BRAKE
    rig.run(2 * PATIENCE_TICKS, swing)
    assert rig.status.state == State.HOLDING
    assert rig.status.reason.startswith("demand 'brake' on ")
    rig.heal()
    rig.rack.demand = Demand.NONE
    rig.run(30, swing)
    assert follows(rig)


def test_a_stuck_sensor_taken_for_a_failing_motor_is_trusted_again_where_the_joint_is() -> None:
    speed = np.full(6, 0.02)  # at once: a joint that does not start looks like a motor at fault
    rig = ServoRig(ROBOT, SCENE, patience=5.0, retry=0.05)
    rig.run(60, lambda time_s: (HOME, 0.0 * speed))
    since = rig.status.target.copy()
    rig.inject("sensor-stuck", joint=-1)
    begun = 60 * 0.0025
    for _ in range(2000):
        rig.run(1, lambda time_s: (since + speed * (time_s - begun), speed))
        if any(f.finding.alarm is Alarm.ACTUATOR for f in rig.found):
            break
    assert rig.status.braked, [f.finding for f in rig.found]
    rest = rig.status.target.copy()
    rig.heal()
    rig.run(RECOVERS_TICKS, lambda time_s: (rest, 0.0 * speed))
    assert follows(rig), rig.status.reason
    assert [f for f in rig.found if f.finding.alarm is Alarm.RE_REFERENCED]
