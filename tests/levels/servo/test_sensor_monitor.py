"""The servo level with faulty sensors: detection in bounded time, braking and resuming."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import Arm, SimulatedArm
from rack.levels.arm.link import Sensed
from rack.levels.messages import Error
from rack.levels.robot.cell import build_cell, replace_encoders
from rack.levels.servo.control import ArmParams
from rack.levels.servo.sensor_monitor import SensorMonitor, compute_tolerance
from rack.levels.tables import RobotConfig, SceneConfig, SensorConfig
from tests.levels.arms import CLOCK_NS, config, pendulum
from tests.levels.servo.rig import BRAKES, GOAL, HOME, MOVE, Course, ServoRig, rig_under_way

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


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "parameters", "alarm", "bound"), KINDS)
def test_a_sensor_fault_is_found_in_time_and_motion_resumes(
    kind: str, parameters: dict[str, float], alarm: Alarm, bound: int
) -> None:
    rig = rig_under_way()
    begun = rig.inject(kind, **parameters)
    for _ in range(200):
        rig.run(1, MOVE.at)
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
    rig.run(40, MOVE.at)
    assert (rig.status.stopped, rig.status.braked, rig.status.reason) == (0, 0, "")
    rig.run(800, lambda _: (GOAL, np.zeros(6)))
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)
    assert (rig.status.violations, rig.status.touches) == (0, 0)
    assert rig.alarms().count(alarm) == 1


@pytest.mark.parametrize("speed", [2e-4, 2e-3, 2e-2])
def test_a_stuck_sensor_is_found_however_slow_the_set_points_are(speed: float) -> None:
    rig, home = ServoRig(*config("puma560")), HOME
    rig.run(60, lambda _: (home, np.zeros(6)))
    begun, slow = rig.inject("sensor-stuck", joint=-1), np.full(6, speed)
    rig.run(200, lambda t: (home + slow * (t - begun * 0.0025), slow))
    # A joint that does not seem to start may as well have a motor at fault.
    assert rig.alarms()[0] in (Alarm.SENSOR_STUCK, Alarm.ACTUATOR)
    assert rig.servo.arm.sense().position == pytest.approx(home, abs=2e-3)


def test_a_joint_that_crept_while_its_sensor_was_stuck_is_trusted_again_where_it_is() -> None:
    rig, home = ServoRig(*config("puma560")), HOME
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


def test_a_joint_remains_in_doubt_until_its_sensor_changes() -> None:
    monitor = SensorMonitor(build_cell(*config("puma560"), CLOCK_NS), ArmParams(), 0.0025, 1)
    rest = np.zeros(6)
    step = np.full(6, 1e-5)
    doubts = []
    for tick, position in enumerate([HOME, HOME + step, HOME + step, HOME]):
        if tick == 2:
            monitor.doubt[:] = 1e-3
        monitor.check_sample(Sensed(position, rest, 0.0, 0.0, tick), tick, None, False)
        doubts.append(monitor.doubt.max())
    assert doubts == [0.0, 0.0, 1e-3, 0.0]


def test_one_lost_sample_is_bridged_with_the_last_torque() -> None:
    rig = rig_under_way()
    torque = rig.status.torque.copy()
    rig.inject("sensor-dropout")
    rig.run(1, MOVE.at)
    rig.heal()
    assert (rig.status.stopped, rig.status.braked) == (0, 0)
    assert rig.status.torque == pytest.approx(torque, rel=0.1)
    rig.run(500, MOVE.at)
    assert rig.alarms() == []
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("reaction", "braked"), [("hold", 0), ("stop", 1)])
def test_with_known_velocities_the_arm_may_ramp_to_rest_instead(reaction: str, braked: int) -> None:
    rig = rig_under_way(on_sensor_fault=reaction)
    rig.inject("sensor-nan", joint=0)
    rig.run(1, MOVE.at)
    assert (rig.status.stopped, rig.status.braked) == (1, 0)
    rig.run(300, MOVE.at)
    assert (rig.status.stopped, rig.status.braked) == (1, braked)
    assert np.abs(rig.servo.arm.sense().velocity).max() < 1e-3
    rig.heal()
    rig.run(800, lambda _: (GOAL, np.zeros(6)))
    assert rig.status.position == pytest.approx(GOAL, abs=1e-3)


def coarse(robot: RobotConfig, resolution: float, noise: float = 0.0) -> RobotConfig:
    return robot.model_copy(update={"sensors": SensorConfig(resolution=resolution, noise=noise)})


def test_samples_are_quantised_but_brakes_and_limit_gate_use_exact_values() -> None:
    robot, scene = config("puma560")
    steps = (1e-3, 0.0, 1e-4, 1e-3, 1e-3, 1e-3)
    sensors = SensorConfig(resolution=steps)
    robot = robot.model_copy(update={"sensors": sensors, "home": (0.1234567, *robot.home[1:])})
    arm = SimulatedArm(build_cell(robot, scene, CLOCK_NS), scene, CLOCK_NS)
    position = arm.sense().position
    assert position[0] == pytest.approx(0.123, abs=1e-12)
    assert position[1] == robot.home[1]
    arm.brake()
    assert arm._rest[0] == 0.1234567


@pytest.mark.slow
@pytest.mark.parametrize(("resolution", "noise"), [(1e-5, 1e-4), (1e-3, 0.0), (1e-3, 1e-4)])
def test_coarse_encoders_lead_to_no_finding(resolution: float, noise: float) -> None:
    robot, scene = config("puma560")
    rig = ServoRig(coarse(robot, resolution, noise), scene)
    rig.run(1000, MOVE.at)
    assert rig.alarms(*BRAKES) == []
    assert rig.servo.arm._state[0] == pytest.approx(GOAL, abs=2e-3)  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "parameters", "error"),
    [
        ("sensor-stuck", {"joint": 1}, Error.SENSORS),
        ("sensor-stuck", {"joint": 4}, Error.SENSORS),
        ("sensor-bias", {"joint": 4, "size": 0.02}, Error.SENSORS),
        ("actuator-off", {"joint": 1}, Error.MOTORS),
    ],
)
def test_a_fault_of_a_coarse_sensor_is_not_taken_for_a_motor_fault(
    kind: str, parameters: dict[str, float], error: Error
) -> None:
    robot, scene = config("puma560")
    rig = ServoRig(coarse(robot, 1e-3), scene, patience=0.4, retry=0.1)
    rig.run(300, MOVE.at)
    rig.inject(kind, **parameters)
    rig.run(60, MOVE.at)
    assert rig.status.state == State.HOLDING
    rig.run(600, MOVE.at)
    assert (rig.status.state, rig.status.error) == (State.ERROR, error)


def test_the_tolerance_follows_from_the_encoders(tmp_path: Path) -> None:
    robot = pendulum(tmp_path)
    cell = build_cell(robot, SceneConfig(), CLOCK_NS)
    exact = compute_tolerance(cell)
    own = compute_tolerance(replace_encoders(cell, robot, Arm.sensors))
    assert exact.position.tolist() == [2.5e-5, 2.5e-5]
    assert own.position == pytest.approx([3.75e-4, 3.75e-4])
    assert own.velocity == pytest.approx([3.5e-3, 3.5e-3])
    # The joint that is faster, 3 rad/s.
    assert own.jitter_s == pytest.approx(0.125e-3)
    given = robot.model_copy(update={"sensors": SensorConfig()})
    assert compute_tolerance(replace_encoders(cell, given, Arm.sensors)).jitter_s == exact.jitter_s
