"""An arm of the user's own keeps its limits, whatever the torques, and whatever its samples say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.boards.config import load, resolve_layout
from rack.boards.errors import ConfigError
from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.arm.guard import GuardedArm
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import SceneConfig, SensorConfig
from tests.levels.arm.test_own_arm import GOAL, START, IdealArm
from tests.levels.arms import pendulum
from tests.levels.lockstep import CLOCK_NS
from tests.levels.servo.rig import Course, ServoRig

EXAMPLE = Path(__file__).resolve().parents[3] / "configs/examples/own-hardware/hardware.toml"
TICK_S = CLOCK_NS * 1e-9


class FarArm(IdealArm):
    """Its samples jump beyond the range of the first joint, or beyond its speed, in some cycles."""

    jumps: dict[int, tuple[float, float]]

    def sense(self) -> Sensed:
        sample = super().sense()
        q, qd = self.jumps.get(self.tick, (0.0, 0.0))
        sample.position[0] += q
        sample.velocity[0] += qd
        return sample


class CoarseArm(IdealArm):
    """Its samples are off by as much as its encoders may be, either way."""

    def sense(self) -> Sensed:
        sample = super().sense()
        error = self.cell.encoders
        random = np.random.default_rng(self.tick)
        way = np.where(random.random((2, len(error.position_error))) < 0.5, -1, 1)
        q, qd = way * (error.position_error, error.velocity_error)
        return sample._replace(position=sample.position + q, velocity=sample.velocity + qd)


def drive_cycles(guard: GuardedArm, arm: IdealArm, torques: Iterator[Array]) -> tuple[Array, Array]:
    """Drive an arm cycle by cycle; return the positions, and the velocities, that it had."""
    arm.enable()
    true = []
    for torque in torques:
        guard.sense()
        guard.drive(torque, 0.0)
        arm.step(1)
        true.append((arm._q.copy(), arm._qd.copy()))
    return np.array([q for q, _ in true]), np.array([qd for _, qd in true])


def compute_excess(cell: Cell, motion: tuple[Array, Array]) -> tuple[float, float]:
    """Return by how much the positions and the velocities of a motion are beyond the limits."""
    positions, velocities = motion
    low, high = cell.bounds.position.T
    beyond = np.maximum(low - positions, positions - high).max()
    return float(beyond), float((np.abs(velocities) - cell.bounds.velocity).max())


def random_torques(cell: Cell, seed: int, cycles: int) -> Iterator[Array]:
    """Yield torques up to the limits, kept for some cycles each."""
    random = np.random.default_rng(seed)
    torque = np.zeros(len(cell.qpos))
    for cycle in range(cycles):
        if cycle % 40 == 0:
            torque = random.uniform(-1.0, 1.0, len(torque)) * cell.bounds.torque
        yield torque


@pytest.mark.slow
def test_an_arm_with_the_coarsest_permitted_encoders_keeps_its_limits(tmp_path: Path) -> None:
    robot = pendulum(tmp_path)
    sensors = SensorConfig(resolution=2e-3, noise=3e-4)
    cell = build_cell(robot.model_copy(update={"sensors": sensors}), SceneConfig(), CLOCK_NS)
    assert cell.encoders.position_error.min() > 2e-3
    arm = CoarseArm(cell, SceneConfig(), CLOCK_NS)
    guard = GuardedArm(arm, TICK_S)
    assert max(compute_excess(cell, drive_cycles(guard, arm, random_torques(cell, 0, 800)))) <= 0.0
    assert arm.clipped > 50
    assert arm.violations == 0


@pytest.mark.slow
def test_missed_cycles_do_not_lead_beyond_a_limit(tmp_path: Path) -> None:
    cell = build_cell(pendulum(tmp_path), SceneConfig(), CLOCK_NS)
    random = np.random.default_rng(0)

    def moved(is_guarded: bool) -> float:
        arm = IdealArm(cell, SceneConfig(), CLOCK_NS)
        link = GuardedArm(arm, TICK_S) if is_guarded else arm
        arm.enable()
        worst = -np.inf
        for torque in random_torques(cell, 0, 800):
            link.sense()
            link.drive(torque, 0.0)
            # The torque is kept until the brakes engage, at the latest.
            for _ in range(random.integers(1, arm.patience, endpoint=True)):
                arm.step(1)
                motion = (arm._q[None], arm._qd[None])
                worst = max(worst, *compute_excess(cell, motion))
        assert arm.violations == 0
        return float(worst)

    assert moved(is_guarded=True) <= 0.0
    assert moved(is_guarded=False) > 0.1


@pytest.mark.parametrize("sample", [(np.nan, 0.0), (0.0, np.nan), (np.inf, 0.0)])
def test_a_sample_that_is_not_finite_brakes(tmp_path: Path, sample: tuple[float, float]) -> None:
    FarArm.jumps = {1: sample}
    arm = FarArm(build_cell(pendulum(tmp_path), SceneConfig(), CLOCK_NS), SceneConfig(), CLOCK_NS)
    arm.enable()
    guard = GuardedArm(arm, TICK_S)
    guard.sense()
    assert guard.drive(np.zeros(2), 0.0) is None
    arm.step(1)
    guard.sense()
    refused = guard.drive(np.zeros(2), 0.0)
    assert refused is not None
    assert (refused.alarm, refused.subject) == (Alarm.LIMIT_EXCEEDED, 0)
    assert (arm.braked, arm.violations) == (True, 1)
    arm.step(1)
    guard.sense()
    assert guard.drive(np.zeros(2), 0.0) is None
    assert not arm.braked


class LyingArm(IdealArm):
    """From tick 150 on its samples are not the truth, or no news."""

    lie = ""

    def sense(self) -> Sensed:
        sample = super().sense()
        since = self.tick - 150
        if since < 0:
            self._before = sample
        lies = {
            "sticks": self._before._replace(tick=self.tick),
            "stalls": self._before,
            "jumps": sample._replace(position=sample.position - 0.3),
            "drifts": sample._replace(position=sample.position - 2e-3 * since),
            "claims": sample._replace(velocity=-sample.velocity),
        }
        return sample if since < 0 else lies[self.lie]


@pytest.mark.parametrize("lie", ["sticks", "stalls", "jumps", "drifts", "claims"])
def test_an_arm_whose_samples_become_wrong_is_braked_within_its_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lie: str
) -> None:
    monkeypatch.setattr(LyingArm, "lie", lie)
    # At the end of the course there is a hand's breadth to the end of the range.
    robot = pendulum(tmp_path, position=((-0.1, 0.7), (-0.5, 0.6)))
    servo = ServoRig(robot, SceneConfig(), arm=f"{__name__}:LyingArm")
    course = Course(START, GOAL, 0.8)
    arm = servo.servo.arm
    assert isinstance(arm, LyingArm)
    worst, braked_at = -np.inf, 0
    for tick in range(400):
        servo.run(1, course.at)
        worst = max(worst, *compute_excess(arm.cell, (arm._q[None], arm._qd[None])))
        if arm.braked and tick > 150 and not braked_at:
            braked_at = tick
    assert worst <= 0.0
    assert 150 < braked_at < 170
    found = {alarm.name for alarm in servo.alarms()}
    assert found & {"SENSOR_STUCK", "SENSOR_SILENT", "SENSOR_MODEL"}


@pytest.mark.slow
@pytest.mark.parametrize(("jump", "what"), [((9.0, 0.0), "position"), ((0.0, 99.0), "velocity")])
def test_a_sample_beyond_a_limit_engages_the_brakes(
    tmp_path: Path, jump: tuple[float, float], what: str
) -> None:
    FarArm.jumps = dict.fromkeys(range(100, 103), jump)
    servo = ServoRig(pendulum(tmp_path), SceneConfig(), arm=f"{__name__}:FarArm")
    course = Course(START, GOAL, 0.8)
    servo.run(100, course.at)
    assert not servo.servo.arm.braked
    servo.run(3, course.at)
    arm = servo.servo.arm
    assert arm.braked
    assert arm.violations == 3
    assert arm.first_violation.startswith(f"{what} ")
    assert "as sensed; permitted: " in arm.first_violation
    assert servo.alarms().count(Alarm.LIMIT_EXCEEDED) == 1
    servo.run(1200, course.at)
    assert servo.status.violations == 3
    assert servo.status.error in (Error.LIMIT, Error.SENSORS)
    if what == "position":
        # Once the samples are right again, it goes on; a velocity that lied leaves doubt.
        assert np.abs(servo.status.position - GOAL).max() < 5e-3


@pytest.mark.slow
def test_during_bring_up_torques_keep_the_reduced_speed(tmp_path: Path) -> None:
    cell = build_cell(pendulum(tmp_path), SceneConfig(), CLOCK_NS)
    arm = IdealArm(cell, SceneConfig(), CLOCK_NS)
    guard = GuardedArm(arm, TICK_S, speed_fraction=0.1)
    _, slow = drive_cycles(guard, arm, random_torques(cell, 0, 800))
    assert (np.abs(slow) / cell.bounds.velocity).max() <= 0.1
    assert (arm.violations, arm.clipped > 50) == (0, True)
    guard.permit_speed(1.0)
    motion = drive_cycles(guard, arm, random_torques(cell, 0, 800))
    assert (np.abs(motion[1]) / cell.bounds.velocity).max() > 0.1
    assert max(compute_excess(cell, motion)) <= 0.0


def test_a_config_whose_arm_cannot_be_guarded_is_refused_before_the_launch() -> None:
    with pytest.raises(ConfigError) as refused:
        resolve_layout(load(EXAMPLE, ["robot.bring_up=0.001"]))
    (mistake,) = refused.value.mistakes
    assert (mistake.place, mistake.value) == ("board.servo.params.arm", "hardware_arm:HardwareArm")
    assert mistake.why == (
        "robot.sensors: 'kj1' may be off by 0.00035 rad, 0.0035 rad/s, which is too coarse to keep"
        " it below 0.001 rad/s; it must be less than half of that"
    )
