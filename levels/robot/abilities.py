"""What an arm can do at rest: how far its tool reaches, what it holds there, and how much torque
gravity leaves.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import OFF

POSES = 1000
"""Poses that are tried, all over the joints' ranges."""
STEPS = 25
"""Positions of a joint that are tried while the arm is stretched out, and turns of all joints."""
TURNS = 4


@dataclass(frozen=True)
class Abilities:
    """Of an arm at rest.

    `reach`, m, is the farthest place of the tool from the axis of the first joint; `payload`, kg, a
    mass at the tool that it holds in every pose tried; `left` the part of a joint's torque that
    gravity leaves in each of them, of the `joint` with the least, by index.
    """

    reach: float
    payload: float
    left: float
    joint: int


def abilities(cell: Cell) -> Abilities:
    """Return what the arm of a cell can do; the worst that is found in many poses, and stretched
    out.
    """
    statics = Statics(cell)
    poses = statics.poses()
    far = statics.stretched(max(poses, key=statics.distance))
    found = [statics.held(position) for position in (*poses, far)]
    left = np.min([parts for parts, _ in found], axis=0)
    joint = int(left.argmin())
    payload = max(0.0, min(mass for _, mass in found))
    return Abilities(statics.distance(far), payload, float(left[joint]), joint)


class Statics:
    """An arm that stands still, without contacts."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._model = copy.copy(cell.model)
        self._model.opt.disableflags |= int(OFF)
        self._data = cell.start()
        self._data.qvel[:] = 0.0
        self._jacobian = np.zeros((3, self._model.nv))
        self._base = int(self._model.dof_jntid[cell.dof[0]])
        # A joint without limits turns once.
        self._low, self._high = np.clip(cell.limits.position, -math.pi, math.pi).T

    def poses(self) -> list[Array]:
        """Return poses all over the joints' ranges, rad, the start first."""
        drawn = np.random.default_rng(0).uniform(self._low, self._high, (POSES - 1, len(self._low)))
        return [self._cell.home, *drawn]

    def stretched(self, position: Array) -> Array:
        """Return a pose that reaches as far as this one, or farther: each joint in turn at its
        best.
        """
        best = position.copy()
        for _ in range(TURNS):
            for joint, (low, high) in enumerate(zip(self._low, self._high, strict=True)):
                tried = np.tile(best, (STEPS, 1))
                tried[:, joint] = np.linspace(low, high, STEPS)
                best = max((best, *tried), key=self.distance)
        return best

    def distance(self, position: Array) -> float:
        """Return the distance of the tool from the axis of the first joint, m."""
        data = self._data
        data.qpos[self._cell.qpos] = position
        mujoco.mj_kinematics(self._model, data)
        out = data.site_xpos[self._cell.tool] - data.xanchor[self._base]
        return norm(np.cross(out, data.xaxis[self._base]))

    def held(self, position: Array) -> tuple[Array, float]:
        """Return the part of each joint's torque that gravity leaves, (joints,), and the mass at
        the tool, kg, that takes all of one.
        """
        cell = self._cell
        data = self._data
        data.qpos[cell.qpos] = position
        mujoco.mj_forward(self._model, data)
        mujoco.mj_jacSite(self._model, data, self._jacobian, None, cell.tool)
        torque = cell.bounds.torque
        own = (data.qfrc_bias - data.qfrc_passive)[cell.dof]
        x, y, z = self._model.opt.gravity
        rows = self._jacobian[:, cell.dof]
        a_kg = -(x * rows[0] + y * rows[1] + z * rows[2])
        loaded = np.abs(a_kg) > 1e-9
        room = (torque - np.sign(a_kg) * own)[loaded] / np.abs(a_kg[loaded])
        return 1.0 - np.abs(own) / torque, float(room.min(initial=math.inf))
