"""The law of hybrid control alone: its inverse, its limits and its constant difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.robot.dynamics import Payload
from rack.levels.servo.curves import Motion
from rack.levels.systems.force.hybrid_law import (
    DAMPING,
    ForceTask,
    HybridGains,
    HybridLaw,
    ToolKinematics,
    solve_damped,
)
from tests.levels.systems.force.pad import pad

PERIOD_S = 0.005
EMPTY = Payload(0.0, np.zeros(3))
Z = np.array([False, False, True, False, False, False])


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return build_cell(*pad(tmp_path), 1_000_000)


def resting(cell: Cell, away: float = 0.0) -> Motion:
    """Return a motion at rest with all joints `away`, rad, from home."""
    return Motion(np.stack((cell.home + away, np.zeros(6), np.zeros(6))))


def task(exerted: Array | None, rotation: Array | None = None) -> ForceTask:
    """Return a task with 20 N along z at 0.05 m/s at most."""
    wanted, turned = np.where(Z, 20.0, 0.0), np.eye(3) if rotation is None else rotation
    return ForceTask(turned, Z, wanted, exerted, np.full(6, 0.05))


def place(cell: Cell, q: Array) -> Array:
    """Return the position of the tool at `q`, m."""
    tool = ToolKinematics(cell)
    tool.evaluate_at(q, np.zeros(6))
    return tool.pose.position


def test_the_inverse_gives_the_velocity_even_at_a_singularity(cell: Cell) -> None:
    tool, twist = ToolKinematics(cell), np.array([0.02, -0.01, 0.03, 0.1, 0.0, -0.1])
    tool.evaluate_at(cell.home, np.zeros(6))
    missed = np.abs(tool.jacobian @ solve_damped(tool.jacobian, twist) - twist)
    assert missed.max() < 0.01 * np.abs(twist).max()
    straight = cell.home.copy()
    straight[4] = 0.0  # joints 4 and 6 turn about one axis
    tool.evaluate_at(straight, np.zeros(6))
    assert np.linalg.svd(tool.jacobian, compute_uv=False)[-1] < 1e-6
    for axis in range(6):
        velocity = solve_damped(tool.jacobian, np.eye(6)[axis])
        assert np.abs(velocity).max() <= 0.5 / np.sqrt(DAMPING)


def test_a_force_axis_moves_at_its_speed_and_others_stay(cell: Cell) -> None:
    law, commands = HybridLaw(cell, HybridGains(bandwidth=50.0)), []
    for _ in range(100):
        commands.append(law.step(resting(cell), task(np.zeros(6)), PERIOD_S, EMPTY))
    places = np.array([place(cell, command.position) for command in commands])
    speeds = np.diff(places, axis=0) / PERIOD_S
    assert speeds[-10:, 2] == pytest.approx(0.05, rel=0.01)
    assert np.abs(places[:, :2] - places[0, :2]).max() < 1e-5
    assert law.offset == pytest.approx(places[-2] - places[0], abs=1e-3)
    # In a task frame whose z axis is the world's x axis it moves along that.
    law = HybridLaw(cell, HybridGains(bandwidth=50.0))
    to_x = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    for _ in range(100):
        command = law.step(resting(cell), task(np.zeros(6), to_x), PERIOD_S, EMPTY)
    way = place(cell, command.position) - place(cell, cell.home)
    assert way[0] > 0.01
    assert np.abs(way[1:]).max() < 1e-4
    # A joint stops at the end of its range.
    high = cell.limits.position[:, 1]
    beyond = Motion(np.stack((high + 0.1, np.ones(6), np.zeros(6))))
    command = law.step(beyond, None, PERIOD_S, EMPTY)
    assert np.array_equal(command.position, high)
    assert not command.velocity.any()


def test_every_joint_keeps_its_acceleration(cell: Cell) -> None:
    law, before = HybridLaw(cell, HybridGains(bandwidth=100.0, smoothing=1e-3)), np.zeros(6)
    for cycle in range(60):
        wanted = task(np.zeros(6)) if cycle < 30 else None
        command = law.step(resting(cell), wanted, PERIOD_S, EMPTY)
        change = command.velocity - before
        assert (np.abs(change) <= 1.001 * cell.limits.acceleration * PERIOD_S).all()
        assert command.acceleration == pytest.approx(change / PERIOD_S)
        before = command.velocity
    assert law.is_at_rest


def test_without_force_axes_the_difference_from_the_motion_stays_constant(cell: Cell) -> None:
    law = HybridLaw(cell, HybridGains())
    assert np.array_equal(law.step(resting(cell), None, PERIOD_S, EMPTY).position, cell.home)
    for _ in range(50):
        law.step(resting(cell), task(np.zeros(6)), PERIOD_S, EMPTY)
    while not law.is_at_rest:
        command = law.step(resting(cell), None, PERIOD_S, EMPTY)
    away = command.position - cell.home
    assert np.abs(away).max() > 1e-4
    moved = law.step(resting(cell, 0.05), None, PERIOD_S, EMPTY)
    assert moved.position == pytest.approx(cell.home + 0.05 + away)
    law.reset_offset()
    assert np.array_equal(law.step(resting(cell), None, PERIOD_S, EMPTY).position, cell.home)


def test_the_wanted_force_is_fed_forward_as_joint_torques(cell: Cell) -> None:
    law, tool = HybridLaw(cell, HybridGains()), ToolKinematics(cell)
    exact = np.where(Z, 20.0, 0.0)
    for _ in range(300):
        command = law.step(resting(cell), task(exact), PERIOD_S, EMPTY)
    tool.evaluate_at(command.position, command.velocity)
    expected = tool.terms.bias + tool.jacobian.T @ exact
    assert command.load == pytest.approx(expected, abs=1e-2)
