"""Where an object sits in the gripper: its pose in the tool's frame, from measured joints and the world model."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.robot.cell import Cell

Array = NDArray[np.float64]


class GraspFrame:
    """Computes poses in the frame of the tool of one arm."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._data = mujoco.MjData(cell.model)
        self._inverse = (np.zeros(3), np.zeros(4))

    def pose_of(self, position: Array, quaternion: Array, q: Array) -> tuple[Array, Array]:
        """Return the pose of a body at `position` (3,), m, and `quaternion` (4,), seen from the tool at joints `q`."""
        data, tool = self._data, self._cell.tool
        data.qpos[self._cell.qpos] = q
        mujoco.mj_kinematics(self._cell.model, data)
        turned = np.zeros(4)
        mujoco.mju_mat2Quat(turned, data.site_xmat[tool])
        mujoco.mju_negPose(*self._inverse, data.site_xpos[tool], turned)
        seen = (np.zeros(3), np.zeros(4))
        mujoco.mju_mulPose(*seen, *self._inverse, position, quaternion)
        return seen
