"""Encoders with a resolution and noise: samples of the arm and tolerance of the monitors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import Arm, SimulatedArm
from rack.levels.messages import Error
from rack.levels.robot.cell import build_cell, replace_encoders
from rack.levels.servo.sensor_monitor import compute_tolerance
from rack.levels.tables import RobotConfig, SceneConfig, SensorConfig
from tests.levels.arms import CLOCK_NS, config, pendulum
from tests.levels.servo.rig import Course, ServoRig

GOAL = np.array([0.6, 1.0, -2.6, 0.4, -1.2, 0.5])
BRAKES = (Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED)


def coarse(robot: RobotConfig, resolution: float, noise: float = 0.0) -> RobotConfig:
    return robot.model_copy(update={"sensors": SensorConfig(resolution=resolution, noise=noise)})


def move() -> Course:
    return Course(np.array(config("puma560")[0].home), GOAL, 2.0)


def test_samples_are_quantised_but_brakes_and_limit_gate_use_exact_values() -> None:
    robot, scene = config("puma560")
    steps = (1e-3, 0.0, 1e-4, 1e-3, 1e-3, 1e-3)
    robot = robot.model_copy(
        update={"sensors": SensorConfig(resolution=steps), "home": (0.1234567, *robot.home[1:])}
    )
    arm = SimulatedArm(build_cell(robot, scene, CLOCK_NS), scene, CLOCK_NS)
    position = arm.sense().position
    assert position[0] == pytest.approx(0.123, abs=1e-12)
    assert position[1] == robot.home[1]
    arm.brake()
    assert arm._rest[0] == 0.1234567


@pytest.mark.slow
@pytest.mark.parametrize(("resolution", "noise"), [(1e-5, 1e-4), (1e-3, 0.0), (1e-3, 1e-4)])
def test_a_move_with_coarse_encoders_reaches_its_goal_without_a_finding(
    resolution: float, noise: float
) -> None:
    robot, scene = config("puma560")
    rig = ServoRig(coarse(robot, resolution, noise), scene)
    rig.run(1000, move().at)
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
    rig.run(300, move().at)
    rig.inject(kind, **parameters)
    rig.run(60, move().at)
    assert rig.status.state == State.HOLDING
    rig.run(600, move().at)
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
