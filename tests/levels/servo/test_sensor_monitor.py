"""The servo level with faulty sensors: detection in bounded time, braking and resuming."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from tests.levels.arms import config
from tests.levels.servo.rig import Course, ServoRig

BRAKES = (Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED)
GOAL = np.array([0.6, 1.0, -2.6, 0.4, -1.2, 0.5])
KINDS = [
    ("sensor-nan", {"joint": 0}, Alarm.SENSOR_RANGE, 0),
    ("sensor-nan", {"joint": -1}, Alarm.SENSOR_RANGE, 0),
    ("sensor-stuck", {"joint": 1}, Alarm.SENSOR_STUCK, 1),
    ("sensor-stuck", {"joint": -1}, Alarm.SENSOR_STUCK, 1),
    ("sensor-dropout", {}, Alarm.SENSOR_SILENT, 1),
    ("sensor-bias", {"size": 0.02, "joint": 2}, Alarm.SENSOR_MODEL, 0),
    ("sensor-bias", {"size": -0.003, "joint": 5}, Alarm.SENSOR_MODEL, 0),
    ("sensor-bias", {"size": 3.0, "joint": 1}, Alarm.SENSOR_MODEL, 0),
    ("sensor-noise", {"size": 0.005, "joint": 0}, Alarm.SENSOR_MODEL, 1),
]


def move() -> Course:
    return Course(np.array(config("puma560")[0].home), GOAL, 2.0)


def rig_under_way(**params: float | str) -> ServoRig:
    rig = ServoRig(*config("puma560"), **params)
    rig.run(400, move().at)
    return rig


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "parameters", "alarm", "bound"), KINDS)
def test_a_sensor_fault_is_found_in_time_and_motion_resumes_with_a_true_status(
    kind: str, parameters: dict[str, float], alarm: Alarm, bound: int
) -> None:
    rig = rig_under_way()
    begun = rig.inject(kind, **parameters)
    for _ in range(200):
        rig.run(1, move().at)
        true = rig.servo.arm.sense()
        assert rig.status.position == pytest.approx(true.position, abs=0.01)
        assert np.isfinite(rig.status.velocity).all()
    assert rig.status.target == pytest.approx(rig.status.position)
    first = rig.found[0]
    assert alarm in rig.alarms()
    assert first.tick - begun <= bound
    assert (rig.status.stopped, rig.status.braked, rig.status.holding) == (1, 1, 1)
    assert rig.status.reason.startswith("sensor")
    assert "; latched at tick " in rig.status.reason
    assert rig.alarms().count(alarm) == 1  # once, however long it lasts
    rig.heal()
    rig.run(40, move().at)
    assert (rig.status.stopped, rig.status.braked, rig.status.reason) == (0, 0, "")
    rig.run(800, lambda _: (GOAL, np.zeros(6)))
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)
    assert (rig.status.violations, rig.status.touches) == (0, 0)
    assert rig.alarms().count(alarm) == 1


@pytest.mark.parametrize("speed", [2e-4, 2e-3, 2e-2])
def test_a_stuck_sensor_is_found_before_its_joint_runs_away_however_slow_the_set_points_are(
    speed: float,
) -> None:
    rig, home = ServoRig(*config("puma560")), move().start
    rig.run(60, lambda _: (home, np.zeros(6)))
    begun, slow = rig.inject("sensor-stuck", joint=-1), np.full(6, speed)
    rig.run(200, lambda t: (home + slow * (t - begun * 0.0025), slow))
    # A joint that does not seem to start may as well have a motor at fault.
    assert rig.alarms()[0] in (Alarm.SENSOR_STUCK, Alarm.ACTUATOR)
    assert rig.servo.arm.sense().position == pytest.approx(home, abs=2e-3)


def test_a_joint_that_crept_while_its_sensor_was_stuck_is_trusted_again_where_it_is() -> None:
    rig, home = ServoRig(*config("puma560")), move().start
    rig.run(200, lambda _: (home, np.zeros(6)))
    rig.inject("sensor-stuck", joint=3)
    begun, crept = rig.rack.tick, home + np.array([0.0, 0.0, 0.0, 4e-5, 0.0, 0.0])
    rig.run(200, lambda t: Course(home, crept, 0.5).at(t - begun * 0.0025))
    assert rig.alarms() == []
    rig.heal()
    rig.run(40, lambda _: (crept, np.zeros(6)))
    assert rig.alarms(*BRAKES) == [Alarm.SENSOR_MODEL, Alarm.RE_REFERENCED]
    assert rig.status.reason == ""
    assert rig.status.position == pytest.approx(rig.servo.arm.sense().position, abs=1e-6)


def test_one_lost_sample_is_bridged_with_the_last_torque() -> None:
    rig = rig_under_way()
    torque = rig.status.torque.copy()
    rig.inject("sensor-dropout")
    rig.run(1, move().at)
    rig.heal()
    assert (rig.status.stopped, rig.status.braked) == (0, 0)
    assert rig.status.torque == pytest.approx(torque, rel=0.1)
    rig.run(500, move().at)
    assert rig.alarms() == []
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("reaction", "braked"), [("hold", 0), ("stop", 1)])
def test_with_known_velocities_the_arm_may_ramp_to_rest_instead(reaction: str, braked: int) -> None:
    rig = rig_under_way(on_sensor_fault=reaction)
    rig.inject("sensor-nan", joint=0)
    rig.run(1, move().at)
    assert (rig.status.stopped, rig.status.braked) == (1, 0)
    rig.run(300, move().at)
    assert (rig.status.stopped, rig.status.braked) == (1, braked)
    assert np.abs(rig.servo.arm.sense().velocity).max() < 1e-3
    rig.heal()
    rig.run(800, lambda _: (GOAL, np.zeros(6)))
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)
