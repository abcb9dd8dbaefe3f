"""Late samples: an arm whose samples are some ticks old is driven as one that is sensed at once."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import Sensed, SimulatedArm
from rack.levels.arm.guard import GuardedArm
from rack.levels.arm.latency_compensation import PresentLink
from rack.levels.arm.link import copy_sample
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import RobotConfig, SceneConfig
from tests.levels.arm.test_guard import TICK_S, compute_excess, drive_cycles, random_torques
from tests.levels.arm.test_own_arm import GOAL, START, IdealArm
from tests.levels.arms import pendulum
from tests.levels.lockstep import CLOCK_NS
from tests.levels.servo.rig import Course, ServoRig

COURSE = Course(START, GOAL, 0.8)
LATE = f"{__name__}:LateArm"


class LateArm(IdealArm):
    """Its samples are `late` ticks old; from tick `stuck_from` on they keep their first joint."""

    late = 0
    stuck_from = 1 << 30

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._stuck: Sensed | None = None
        self._begin()

    def restore(self, state: Message) -> None:
        super().restore(state)
        self._begin()

    def _begin(self) -> None:
        """Let the bus have sampled the arm before, at rest."""
        ages = range(self.late, -1, -1)
        here = super().sense()
        self._samples = deque((here._replace(tick=self.tick - age) for age in ages), len(ages))

    def step(self, ticks: int) -> None:
        for _ in range(ticks):
            super().step(1)
            self._samples.append(super().sense())

    def sense(self) -> Sensed:
        sample = copy_sample(self._samples[0])
        if self.tick >= self.stuck_from:
            self._stuck = self._stuck or copy_sample(sample)
            sample.position[0] = self._stuck.position[0]
            sample.velocity[0] = self._stuck.velocity[0]
        return sample


@pytest.fixture(autouse=True)
def arm() -> type[LateArm]:
    """The arm's class, as it is at first."""
    LateArm.late, LateArm.stuck_from = 0, 1 << 30
    return LateArm


def build_late_arm(folder: Path, ticks: int) -> tuple[RobotConfig, Cell]:
    robot = pendulum(folder, latency_ticks=ticks)
    return robot, build_cell(robot, SceneConfig(), CLOCK_NS)


def rig(folder: Path, latency: int, name: str = LATE) -> ServoRig:
    params = {"arm": name} if name else {}
    return ServoRig(build_late_arm(folder, latency)[0], SceneConfig(), **params)


@pytest.mark.parametrize("ticks", [1, 3])
@pytest.mark.parametrize("age", [0, 1, 3])
def test_a_sample_is_extrapolated_if_it_is_not_too_old(
    tmp_path: Path, arm: type[LateArm], ticks: int, age: int
) -> None:
    _, cell = build_late_arm(tmp_path, ticks)
    arm.late = age
    own = arm(cell, SceneConfig(), CLOCK_NS)
    link = PresentLink(own, TICK_S)
    brought, as_sensed = [], []
    for torque in random_torques(cell, 3, 400):
        raw, sample, _ = link.estimate_present()
        assert sample.tick == (own.tick if own.tick - raw.tick <= ticks else raw.tick)
        if own.tick > age:
            brought.append(np.abs(sample.position - own._q))
            as_sensed.append(np.abs(raw.position - own._q))
        own.drive(0.3 * torque, 0.0)
        own.step(1)
    worst, before = np.max(brought, axis=0), np.max(as_sensed, axis=0)
    if age > ticks:
        assert (worst == before).all()
    elif age:
        assert (worst < 0.02 * before).all()


@pytest.mark.slow
@pytest.mark.parametrize("latency", [1, 4])
@pytest.mark.parametrize("simulated", [False, True], ids=["own", "simulated"])
def test_a_late_arm_follows_its_set_points_without_an_alarm(
    tmp_path: Path, arm: type[LateArm], latency: int, simulated: bool
) -> None:
    arm.late = latency
    servo = rig(tmp_path, latency, "" if simulated else LATE)
    assert isinstance(servo.servo.arm, SimulatedArm if simulated else LateArm)
    servo.run(400, COURSE.at)
    assert servo.servo.arm.tick - servo.servo.arm.sense().tick == latency
    assert not servo.alarms()
    assert np.abs(servo.status.position - GOAL).max() < 2e-3
    assert (servo.status.violations, servo.status.error) == (0, Error.NONE)
    servo.restart()
    servo.run(200, lambda _: (GOAL, np.zeros(2)))
    assert not servo.alarms(Alarm.BRAKES_OPENED)
    assert np.abs(servo.status.position - GOAL).max() < 5e-3


@pytest.mark.parametrize(("age", "latency"), [(1, 0), (3, 2), (4, 0)])
def test_samples_that_are_too_old_are_a_finding_with_their_age(
    tmp_path: Path, arm: type[LateArm], age: int, latency: int
) -> None:
    arm.late = age
    servo = rig(tmp_path, latency)
    servo.run(60, COURSE.at)
    assert servo.alarms() == [Alarm.SENSOR_LATE]
    found = servo.found[0]
    assert (found.finding.subject, found.finding.value) == (-1, age)
    assert found.tick == 1
    assert servo.status.braked
    assert servo.status.error == Error.NONE
    assert servo.status.reason.startswith(f"the newest sample is {age} ticks old; permitted by ")
    assert f"permitted by robot.latency_ticks: {latency}" in servo.status.reason


@pytest.mark.slow
def test_late_samples_do_not_lead_beyond_a_limit(tmp_path: Path, arm: type[LateArm]) -> None:
    _, cell = build_late_arm(tmp_path, 4)
    arm.late = 4
    own = arm(cell, SceneConfig(), CLOCK_NS)
    guard = GuardedArm(own, TICK_S, PresentLink(own, TICK_S))
    assert max(compute_excess(cell, drive_cycles(guard, own, random_torques(cell, 0, 800)))) <= 0.0
    assert own.clipped > 50
    assert own.violations == 0
