"""Kinematics of the fingers: tips and Jacobians in the palm's frame, and inverse kinematics.

They are evaluated on separate MuJoCo data, like the dynamics of an arm
(`rack.levels.robot.dynamics`), so that results depend on the joint positions alone. The palm does
not move.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import Array, mat_vec, solve, transposed_mat_vec
from rack.levels.planning.pose import read_site_pose
from rack.levels.robot.cell import Cell
from rack.levels.robot.hand import Hand

DAMPING_M2 = 1e-5
"""Damping of a step of inverse kinematics, (3 mm/rad)^2. The tip of a bent finger moves by 80
mm/rad."""
MARGIN_RAD = 0.01
"""Distance of targets from the ends of a joint's range."""


class FingerKinematics:
    """The fingers of one hand."""

    def __init__(self, cell: Cell, hand: Hand) -> None:
        self._cell = cell
        self._tips = hand.tips
        # Indices in `robot.joints` of the joints of each finger.
        self.joints = [np.flatnonzero(row) for row in hand.fingers]
        self._data = d = mujoco.MjData(cell.model)
        mujoco.mj_resetDataKeyframe(cell.model, d, 0)
        self.limits = cell.limits
        self._low = self.limits.position[:, 0] + MARGIN_RAD
        self._high = self.limits.position[:, 1] - MARGIN_RAD
        self._whole = np.zeros((3, cell.model.nv))
        mujoco.mj_kinematics(cell.model, d)
        self.palm = read_site_pose(d, cell.tool)  # pose in the world
        # Rotates vectors from the frame of the palm into the world.
        self.rotation = d.site_xmat[cell.tool].reshape(3, 3).copy()

    def set_position(self, position: Array) -> None:
        """Set the joint positions, (joints,), in rad, at which tips and Jacobians are evaluated."""
        self._data.qpos[self._cell.qpos] = position
        mujoco.mj_kinematics(self._cell.model, self._data)
        mujoco.mj_comPos(self._cell.model, self._data)

    def find_tip(self, finger: int) -> Array:
        """Return the position of a finger's tip in the frame of the palm, (3,), in m."""
        return self.to_palm_frame(self._data.site_xpos[self._tips[finger]])

    def to_palm_frame(self, point: Array) -> Array:
        """Convert a point, (3,), in m, from the frame of the world to the frame of the palm."""
        return transposed_mat_vec(self.rotation, point - self.palm.position)

    def find_jacobian(self, finger: int) -> Array:
        """Return the Jacobian of a finger's tip with respect to the joints of the finger.

        Its shape is (3, joints of the finger), its unit m/rad.
        """
        mujoco.mj_jacSite(self._cell.model, self._data, self._whole, None, self._tips[finger])
        finger_jacobian = np.take(self._whole, self._cell.dof[self.joints[finger]], axis=1)
        rotated = np.empty_like(finger_jacobian)
        mujoco.mju_mulMatTMat(rotated, self.rotation, finger_jacobian)
        return rotated

    def step_towards(self, finger: int, position: Array, way: Array, homing: Array) -> None:
        """Make one damped step of inverse kinematics.

        Call `set_position(position)` first. A finger has a redundant joint: of all joint motions
        that move the tip by `way`, this step takes the motion nearest to `homing`.

        Args:
            finger: Index of the finger.
            position: Joint positions, (joints,), rad; those of the finger are modified in place.
            way: Displacement of the tip, (3,), m.
            homing: Preferred joint motion, (joints of the finger,), rad.
        """
        finger_joints = self.joints[finger]
        jacobian = self.find_jacobian(finger)
        square = np.empty((3, 3))
        mujoco.mju_mulMatMatT(square, jacobian, jacobian)
        square.flat[::4] += DAMPING_M2
        moved = homing + transposed_mat_vec(
            jacobian, solve(square, way - mat_vec(jacobian, homing))
        )
        position[finger_joints] = np.clip(
            position[finger_joints] + moved, self._low[finger_joints], self._high[finger_joints]
        )
