"""The simulated arm: exact time, exact restarts, limits at every step, and unintended contacts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.arm import SimulatedArm, substeps
from rack.levels.arm.simulation import compute_obstacle_position, compute_push_force
from rack.levels.messages import ArmState, Scene
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import Cell, compute_sizes
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import MotionConfig, PushConfig
from tests.levels.arms import CLOCK_NS, cell, config, save_state

TICK_S = CLOCK_NS * 1e-9


def build_arm(name: str) -> tuple[SimulatedArm, Cell]:
    made = cell(name)
    return SimulatedArm(made, config(name)[1], CLOCK_NS), made


def build_wobble(made: Cell) -> Callable[[int], Array]:
    """Torques that swing the arm about home, a function of the tick alone."""
    bias = Dynamics(made).terms(made.home, np.zeros(len(made.home))).bias.copy()
    return lambda tick: bias + 0.2 * made.bounds.torque * np.sin(0.05 * tick + np.arange(len(bias)))


def test_simulated_time_is_the_tick_times_the_period_exactly() -> None:
    arm, made = build_arm("puma560")
    time = mujoco.mj_stateSize(made.model, mujoco.mjtState.mjSTATE_TIME)
    for ticks in (1, 1, 7, 1, 30):
        arm.drive(np.zeros(6), 0.0)
        arm.step(ticks)
        assert save_state(arm).state[:time] == [arm.tick * CLOCK_NS * 1e-9]
    assert arm.tick == 40


def test_a_restored_arm_continues_bit_for_bit() -> None:
    arm, made = build_arm("puma560")
    torque, middle = build_wobble(made), ArmState.zeros(compute_sizes(made))
    for tick in range(200):
        if tick == 120:
            arm.save(middle)
        arm.drive(torque(tick), 20.0)
        arm.step(1)
    again, _ = build_arm("puma560")
    again.restore(middle)
    assert (again.tick, again.grip_force) == (120, 20.0)
    for tick in range(120, 200):
        again.drive(torque(tick), 20.0)
        again.step(1)
    assert save_state(again).raw == save_state(arm).raw


@pytest.mark.slow
def test_limits_hold_at_every_step_whatever_is_commanded(monkeypatch: pytest.MonkeyPatch) -> None:
    arm, made = build_arm("puma560")
    # A contact would stop the arm.
    arm._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    step, rng, data = substeps.mj_step, np.random.default_rng(7), arm._data
    positions, speeds, torques = list[Array](), list[Array](), list[Array]()

    def stepping(*addresses: int) -> None:
        step(*addresses)
        positions.append(data.qpos[made.qpos])
        speeds.append(np.abs(data.qvel[made.dof]) / made.bounds.velocity)
        torques.append(np.abs(data.qfrc_actuator[made.dof]) / made.bounds.torque)

    # Every MuJoCo step is looked at: the arm makes them in Python.
    monkeypatch.setattr(substeps, "mj_step", stepping)
    monkeypatch.setattr(arm, "_advance", substeps.make_steps)
    for block in range(60):
        side = rng.choice([-1.0, 1.0], len(made.home)) if block < 40 else np.ones(len(made.home))
        for _ in range(20):
            arm.drive(side * made.bounds.torque, 0.0)
            arm.step(1)
    assert len(positions) == 60 * 20 * 5
    # Also when commands stop coming at speed.
    for missed in (1, 3, 10, 1, 80):
        for _ in range(60):
            arm.drive(made.bounds.torque * [1, -1, 1, 1, -1, 1], 0.0)
            arm.step(1)
        arm.step(missed)
    assert 0.9 < np.max(speeds) <= 1.0
    assert 0.9 < np.max(torques) <= 1.0
    low, high = made.bounds.position.T
    assert np.max([low - positions, positions - high]) <= 0.0
    assert arm.clipped > 60 * 20 / 2
    assert arm.violations == 0


def test_a_broken_simulation_leaves_the_last_valid_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arm, _ = build_arm("puma560")
    arm.step(5)
    sound = save_state(arm)
    arm._model.dof_damping[0] = np.nan
    arm.step(3)
    assert "MuJoCo warning mjWARN_BAD" in arm.fault
    assert arm.tick == 8
    after = save_state(arm)
    assert np.array_equal(after.state[1:], sound.state[1:])  # all but the time
    assert not list(tmp_path.iterdir())  # MuJoCo's own log file


@pytest.mark.slow
def test_contact_of_arm_and_table_is_counted_but_not_objects_on_the_table() -> None:
    arm, made = build_arm("puma560")
    for _ in range(200):
        arm.drive(build_wobble(made)(0), 0.0)
        arm.step(1)
    assert (arm.touches, arm.first_touch) == (0, "")
    for _ in range(800):
        arm.drive(np.zeros(6), 0.0)
        arm.step(1)
    assert arm.touches > 0
    assert " touches " in arm.first_touch
    assert arm.first_touch.endswith(" s")


def test_obstacle_motion_is_a_function_of_time_and_moves_follow_each_other() -> None:
    moves = (
        MotionConfig(body="post", at=5.0, to=(0.0, 0.0, 0.0), speed=1.0),
        MotionConfig(body="post", at=1.0, to=(2.0, 0.0, 0.0), speed=0.5),
    )
    start = np.zeros(3)
    expected = {0.0: 0.0, 1.0: 0.0, 2.0: 0.5, 4.9: 1.95, 5.0: 2.0, 5.5: 1.5, 9.0: 0.0}
    for time_s in (9.0, 2.0, 5.5, 0.0, 4.9, 1.0, 5.0):
        place = compute_obstacle_position(start, moves, time_s)
        assert place == pytest.approx([expected[time_s], 0.0, 0.0])
    # One that is cut short by the next goes on from where it was.
    moves = (
        MotionConfig(body="post", at=0.0, to=(2.0, 0.0, 0.0), speed=0.5),
        MotionConfig(body="post", at=2.0, to=(1.0, 3.0, 0.0), speed=1.0),
    )
    assert compute_obstacle_position(start, moves, 3.0) == pytest.approx([1.0, 1.0, 0.0])


def test_the_scene_shows_moving_obstacles_objects_and_the_tool_where_they_are() -> None:
    made, (_, scene) = cell("puma560_crossing"), config("puma560_crossing")
    motion = (MotionConfig(body="post", at=0.1, to=(0.62, 0.0, 0.9)),)
    soon = scene.model_copy(update={"motion": motion})
    arm = SimulatedArm(made, soon, CLOCK_NS)
    arm.step(240)
    seen = Scene.zeros(compute_sizes(made))
    arm.look(seen)
    post = len(scene.objects)
    assert seen.position[post] == pytest.approx([0.62, 0.85 - 0.25 * (239 * TICK_S - 0.1), 0.9])
    assert seen.position[0] == pytest.approx([0.5, 0.3, 0.475], abs=1e-3)
    tool = InverseKinematics(made, 0).compute_tool_pose(arm.sense().position)
    assert seen.tool_position == pytest.approx(tool.position, abs=1e-12)
    assert seen.tool_quaternion == pytest.approx(tool.quaternion, abs=1e-12)


UP = PushConfig(body="peg", at=1.0, seconds=0.5, force=(0.0, 0.0, 4.0), rise=0.2)


@pytest.mark.parametrize(
    ("time_s", "part"),
    [(0.99, 0.0), (1.0, 0.0), (1.1, 0.5), (1.2, 1.0), (1.3, 1.0), (1.45, 0.25), (1.5, 0.0)],
)
def test_a_push_rises_lasts_and_falls(time_s: float, part: float) -> None:
    assert compute_push_force((UP,), time_s) == pytest.approx([0.0, 0.0, 4.0 * part])
    aside = PushConfig(body="peg", at=0.5, seconds=2.0, force=(1.0, 0.0, 0.0))
    assert compute_push_force((UP, aside), time_s) == pytest.approx([1.0, 0.0, 4.0 * part])
