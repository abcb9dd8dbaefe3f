"""How far each joint moves the arm: the metric of joint space in which planning thinks."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import below, geoms_of

SAMPLES = 64
"""Random configurations over which the largest lever is taken."""


def lever_arms(cell: Cell, seed: int) -> NDArray[np.float64]:
    """Return (joints,): the farthest that 1 rad (or 1 m) of each joint moves any geom behind it, in m.

    A joint step dq moves no point of the arm by more than sum |lever_j dq_j|.
    """
    data, rng = mujoco.MjData(cell.model), np.random.default_rng(seed)
    levers = np.zeros(len(cell.qpos))
    low, high = sampling_range(cell)
    for _ in range(SAMPLES):
        data.qpos[cell.qpos] = rng.uniform(low, high)
        mujoco.mj_kinematics(cell.model, data)
        np.maximum(levers, [_lever(cell, data, j) for j in range(len(levers))], out=levers)
    return levers


def sampling_range(cell: Cell) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return low and high (joints,), in rad: the limits, and one turn where a joint has none."""
    low, high = cell.limits.position[:, 0], cell.limits.position[:, 1]
    return np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)


def _lever(cell: Cell, data: mujoco.MjData, joint: int) -> float:
    m, dof = cell.model, cell.dof[joint]
    index = int(m.dof_jntid[dof])
    if m.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE:
        return 1.0
    behind = geoms_of(m, below(m, m.jnt_bodyid[[index]]))
    moved = np.intersect1d(behind, cell.arm_geoms)
    if not moved.size:
        return 0.0
    from_axis = np.cross(data.geom_xpos[moved] - data.xanchor[index], data.xaxis[index])
    return float(np.max(np.linalg.norm(from_axis, axis=1) + m.geom_rbound[moved]))
