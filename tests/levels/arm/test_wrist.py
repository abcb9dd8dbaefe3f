"""The wrist sensor of the simulated arm, and the contact that follows from its samples."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.arm import SimulatedArm
from rack.levels.robot.cell import build_cell
from rack.levels.systems.force.arm_executor import compute_contact
from tests.levels.arms import save_state
from tests.levels.systems.force.pad import pad

CLOCK_NS = 1_000_000
STILL = np.zeros(6)


def build_arm(folder: Path, home: tuple[float, ...] | None = None, **wrist: float) -> SimulatedArm:
    robot, scene = pad(folder, **wrist)
    robot = robot if home is None else robot.model_copy(update={"home": home})
    return SimulatedArm(build_cell(robot, scene, CLOCK_NS), scene, CLOCK_NS, seed=7)


def sense_wrist(arm: SimulatedArm) -> Array:
    sample = arm.sense_wrist()
    assert sample is not None
    return sample


@pytest.mark.parametrize(
    "home", [(0.0, 1.4, -3.1, 0.0, -1.4416, 0.0), (0.6, 1.0, -2.6, 0.7, -0.9, 1.1)]
)
def test_a_push_on_the_tool_is_the_wrench(tmp_path: Path, home: tuple[float, ...]) -> None:
    arm = build_arm(tmp_path, home)
    force, torque = np.array([5.0, -9.0, 12.0]), np.array([0.4, 0.3, -0.2])
    cell, data = arm.cell, arm._data
    body = cell.model.site_bodyid[cell.tool]
    for _ in range(200):
        # The tool is pushed at its site.
        away = data.site_xpos[cell.tool] - data.xipos[body]
        data.xfrc_applied[body] = [*force, *(torque + np.cross(away, force))]
        arm.step(1)
    sensed, state = sense_wrist(arm), np.array(arm._state)
    wrench, felt = compute_contact(arm.cell, arm.dynamics, sensed, state, STILL)
    assert np.allclose(wrench, (*force, *torque), atol=0.02)
    jacobian = np.zeros((6, arm.cell.model.nv))
    mujoco.mj_jacSite(arm.cell.model, arm._data, jacobian[:3], jacobian[3:], arm.cell.tool)
    expected = jacobian[:, arm.cell.dof].T @ np.concatenate((force, torque))
    assert np.allclose(felt, expected, atol=0.02)


def test_a_restored_arm_senses_the_same_bits(tmp_path: Path) -> None:
    arms = [build_arm(tmp_path, noise=0.2) for _ in range(2)]
    for _ in range(40):
        arms[0].drive(arms[0].dynamics.terms(*arms[0]._state).bias, 0.0)
        arms[0].step(1)
    arms[1].restore(save_state(arms[0]))
    for arm in arms:
        arm.step(1)
    assert sense_wrist(arms[0]).tobytes() == sense_wrist(arms[1]).tobytes()
