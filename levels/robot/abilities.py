"""Abilities of an arm at rest: reach, payload, and torque left by gravity."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import DISABLED_PARTS

POSE_COUNT = 1000
"""Number of random poses that are tried, over the joints' whole ranges."""
JOINT_STEPS = 25
"""Number of positions of a joint that are tried in each pass of stretching out the arm."""
STRETCH_PASSES = 4
"""Number of passes over all joints in stretching out the arm."""


@dataclass(frozen=True)
class Abilities:
    """Abilities of an arm at rest.

    Attributes:
        reach: Largest distance of the tool from the axis of the first joint, m.
        payload: Largest mass at the tool that the arm can hold in every pose tried, kg.
        torque_left: Smallest fraction of a joint's torque that gravity leaves in any pose tried.
        joint: Index of the joint with this smallest fraction.
    """

    reach: float
    payload: float
    torque_left: float
    joint: int


def compute_abilities(cell: Cell) -> Abilities:
    """Compute the abilities of a cell's arm from random poses and a stretched-out pose."""
    statics = Statics(cell)
    poses = statics.draw_poses()
    stretched = statics.stretch_out(max(poses, key=statics.compute_reach))
    limits = [statics.compute_load_limits(position) for position in (*poses, stretched)]
    torque_left = np.min([parts for parts, _ in limits], axis=0)
    joint = int(torque_left.argmin())
    payload = max(0.0, min(mass for _, mass in limits))
    return Abilities(statics.compute_reach(stretched), payload, float(torque_left[joint]), joint)


class Statics:
    """Computes the reach and the load limits of an arm at rest, ignoring contacts."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._model = copy.copy(cell.model)
        self._model.opt.disableflags |= int(DISABLED_PARTS)
        self._data = cell.build_start_data()
        self._data.qvel[:] = 0.0
        self._jacobian = np.zeros((3, self._model.nv))
        self._base = int(self._model.dof_jntid[cell.dof[0]])
        # A joint without limits is tried over one turn.
        self._low, self._high = np.clip(cell.limits.position, -math.pi, math.pi).T

    def draw_poses(self) -> list[Array]:
        """Return home and random poses over the joints' whole ranges, (joints,) each, in rad."""
        drawn = np.random.default_rng(0).uniform(
            self._low, self._high, (POSE_COUNT - 1, len(self._low))
        )
        return [self._cell.home, *drawn]

    def stretch_out(self, position: Array) -> Array:
        """Return a pose that reaches at least as far as `position`.

        Each joint in turn moves to the position with the largest reach.
        """
        best = position.copy()
        for _ in range(STRETCH_PASSES):
            for joint, (low, high) in enumerate(zip(self._low, self._high, strict=True)):
                tried = np.tile(best, (JOINT_STEPS, 1))
                tried[:, joint] = np.linspace(low, high, JOINT_STEPS)
                best = max((best, *tried), key=self.compute_reach)
        return best

    def compute_reach(self, position: Array) -> float:
        """Return the distance of the tool from the axis of the first joint, in m."""
        data = self._data
        data.qpos[self._cell.qpos] = position
        mujoco.mj_kinematics(self._model, data)
        out = data.site_xpos[self._cell.tool] - data.xanchor[self._base]
        return norm(np.cross(out, data.xaxis[self._base]))

    def compute_load_limits(self, position: Array) -> tuple[Array, float]:
        """Return the torque reserve of each joint, and the payload, in a pose.

        Returns:
            Fraction of each joint's torque limit that gravity does not use, (joints,), and the
            smallest mass at the tool with which a joint reaches its torque limit, kg.
        """
        cell = self._cell
        data = self._data
        data.qpos[cell.qpos] = position
        mujoco.mj_forward(self._model, data)
        mujoco.mj_jacSite(self._model, data, self._jacobian, None, cell.tool)
        torque = cell.bounds.torque
        gravity_torque = (data.qfrc_bias - data.qfrc_passive)[cell.dof]
        x, y, z = self._model.opt.gravity
        rows = self._jacobian[:, cell.dof]
        a_kg = -(x * rows[0] + y * rows[1] + z * rows[2])
        loaded = np.abs(a_kg) > 1e-9
        masses = (torque - np.sign(a_kg) * gravity_torque)[loaded] / np.abs(a_kg[loaded])
        return 1.0 - np.abs(gravity_torque) / torque, float(masses.min(initial=math.inf))
