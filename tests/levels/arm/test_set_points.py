"""Arms whose drives follow set points keep their limits, whatever the set points are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.arm import Arm, JointTarget, SimulatedArm
from rack.levels.arm import simulated as simulated_arm
from rack.levels.arm.guard import GuardedArm
from rack.levels.arm.simulated import CascadedDrives
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import Interface, SceneConfig
from tests.levels.arm.test_guard import compute_excess
from tests.levels.arm.test_own_arm import SUBSTEPS, IdealArm
from tests.levels.arms import CLOCK_NS, config, pendulum, save_state

TICK_S = CLOCK_NS * 1e-9
SET_POINTS: tuple[Interface, ...] = ("position", "velocity")


@pytest.fixture(params=SET_POINTS)
def interface(request: pytest.FixtureRequest) -> Interface:
    return cast(Interface, request.param)


@pytest.fixture(params=[False, True], ids=["simulated", "own"])
def link(request: pytest.FixtureRequest, tmp_path: Path, interface: Interface) -> Link:
    """An arm, and what drives it."""
    if request.param:
        return build_guarded(tmp_path, interface)
    arm, _ = build_simulated("puma560", interface)
    return arm, arm


class ServoArm(IdealArm):
    """An arm of one's own with position or velocity servos, which know limits of torque alone."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._rows = np.zeros((3, len(self.cell.home)))
        drives = self.cell, self._dynamics, self._step_s, self.every * SUBSTEPS, self._rows
        self._servos = CascadedDrives(*drives)

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        self._rows[:2] = target.position, target.velocity
        if self.braked:
            self._servos.start(target.torque, self._q, self._qd)
        self.torque = target.torque.copy()
        self.waited, self.braked = 0, False
        return None

    def compute_torque(self, step: int) -> Array:
        now = SUBSTEPS * self.waited + step
        return self._servos.compute_torque(self._q, self._qd, now)


def build_simulated(name: str, interface: Interface) -> tuple[SimulatedArm, Cell]:
    robot, scene = config(name)
    made = build_cell(robot.model_copy(update={"interface": interface}), scene, CLOCK_NS)
    made.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return SimulatedArm(made, scene, CLOCK_NS), made


def build_guarded(folder: Path, interface: Interface) -> tuple[ServoArm, GuardedArm]:
    robot = pendulum(folder, interface=interface)
    arm = ServoArm(build_cell(robot, SceneConfig(), CLOCK_NS), SceneConfig(), CLOCK_NS)
    return arm, GuardedArm(arm, TICK_S)


def draw_hostile_targets(cell: Cell, kind: str, cycles: int) -> Iterator[JointTarget]:
    """Yield set points that no level would give, after one where the arm starts."""
    random = np.random.default_rng(3)
    low, high = np.clip(cell.bounds.position.T, -3.0, 3.0)
    fastest = cell.bounds.velocity
    holding = compute_load(cell)
    yield JointTarget(cell.home, 0.0 * fastest, holding)
    position, velocity = cell.home.copy(), np.zeros(len(cell.home))
    for cycle in range(cycles):
        if kind == "jumps" and cycle % 60 == 0:
            position = random.uniform(low, high)
            velocity = random.uniform(-3.0, 3.0, len(low)) * fastest
        elif kind == "swings":
            position = np.where(cycle % 7 < 3, low, high)
            velocity = 9.0 * fastest * (-1) ** cycle
        elif kind == "ramps":
            velocity = fastest * np.where(cycle // 400 % 2, 1.2, -1.2)
            position = position + velocity * TICK_S
        elif kind == "beyond":
            position = np.where(cycle // 300 % 2, low - 1.0, high + 1.0)
            velocity = np.where(cycle // 300 % 2, -5.0, 5.0) * fastest
        yield JointTarget(position, velocity, holding)


Link = tuple[Arm, Arm | GuardedArm]


def compute_load(cell: Cell) -> Array:
    """Return the torques, N m, that hold the arm at home."""
    data = cell.build_start_data()
    return np.asarray(data.qfrc_bias - data.qfrc_passive)[cell.dof]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["jumps", "swings", "ramps", "beyond"])
def test_no_set_points_exceed_limits_of_the_simulated_arm(interface: Interface, kind: str) -> None:
    arm, made = build_simulated("puma560", interface)
    fastest = 0.0
    for target in draw_hostile_targets(made, kind, 400):
        assert arm.follow(target, 0.0) is None
        arm.step(1)
        fastest = max(fastest, float(np.max(np.abs(arm.sense().velocity) / made.bounds.velocity)))
    assert arm.violations == 0
    assert arm.clipped > 50
    assert fastest > 0.9 or kind == "swings"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["jumps", "beyond"])
def test_no_set_points_exceed_limits_of_a_guarded_arm_that_misses_cycles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interface: Interface, kind: str
) -> None:
    # Its drives cycle at 4 kHz, so they may be quick.
    monkeypatch.setattr(simulated_arm, "VELOCITY_GAIN", 400.0)

    def beyond(is_guarded: bool) -> float:
        arm, guard = build_guarded(tmp_path, interface)
        random = np.random.default_rng(1)
        worst = -np.inf
        for target in draw_hostile_targets(arm.cell, kind, 400):
            guard.sense()
            assert (guard if is_guarded else arm).follow(target, 0.0) is None or not is_guarded
            for _ in range(random.integers(1, arm.patience, endpoint=True)):
                arm.step(1)
                worst = max(worst, *compute_excess(arm.cell, (arm._q[None], arm._qd[None])))
        assert arm.violations == 0 or not is_guarded
        return worst

    assert beyond(is_guarded=True) <= 0.0
    assert beyond(is_guarded=False) > 0.1


@pytest.mark.parametrize(
    ("wrong", "alarm"),
    [
        ({"position": np.nan}, Alarm.SET_POINT),
        ({"velocity": np.inf}, Alarm.SET_POINT),
        ({"torque": np.nan}, Alarm.COMMAND_INVALID),
        ({"torque": 1e4}, Alarm.COMMAND_LIMIT),
    ],
)
def test_an_invalid_set_point_brakes(link: Link, wrong: dict[str, float], alarm: Alarm) -> None:
    arm, driven = link
    good = JointTarget(arm.cell.home, 0.0 * arm.cell.home, compute_load(arm.cell))
    driven.sense()
    assert driven.follow(good, 0.0) is None
    assert not arm.braked
    arm.step(1)
    driven.sense()
    ((field, value),) = wrong.items()
    bad = getattr(good, field).copy()
    bad[1] = value
    refused = driven.follow(good._replace(**{field: bad}), 0.0)
    assert refused is not None
    assert (refused.alarm, refused.subject) == (alarm, 1)
    assert (arm.braked, arm.clipped) == (True, 1)
    # The next good one is followed again.
    driven.sense()
    assert driven.follow(good, 0.0) is None


def test_the_first_set_point_after_brakes_must_be_where_the_arm_is(link: Link) -> None:
    arm, driven = link
    there = arm.cell.home.copy()
    there[1] += 0.02
    away = JointTarget(there, 0.0 * there, compute_load(arm.cell))
    for _ in range(3):
        driven.sense()
        refused = driven.follow(away, 0.0)
        assert refused is not None
        assert (refused.alarm, refused.subject) == (Alarm.SET_POINT, 1)
        assert refused.value == pytest.approx(0.02, abs=1e-3)
        assert arm.braked
        arm.step(1)
    driven.sense()
    assert driven.follow(away._replace(position=driven.sense().position), 0.0) is None
    assert not arm.braked


@pytest.mark.parametrize("missed", [0, 1, 5])
def test_a_restored_arm_continues_bit_for_bit(interface: Interface, missed: int) -> None:
    arm, made = build_simulated("puma560", interface)
    targets = list(draw_hostile_targets(made, "jumps", 200))
    for target in targets[:150]:
        arm.follow(target, 0.0)
        arm.step(1)
    again, _ = build_simulated("puma560", interface)
    again.restore(save_state(arm))
    for each in (arm, again):
        each.step(missed)
        for target in targets[150:]:
            each.follow(target, 0.0)
            each.step(1)
    assert save_state(again).raw == save_state(arm).raw
