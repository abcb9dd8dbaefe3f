"""Poses of the tool: where it is and how it is turned."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rack.levels.algebra import norm

Array = NDArray[np.float64]

SAME = 1e-6
"""Poses closer than this, in m and in rad, are one pose."""
PARALLEL = 1e-9
"""Two unit directions whose cross product is shorter than this are parallel."""


class Pose(NamedTuple):
    """Position (3,), in m, and unit quaternion (4,), as w, x, y, z; of the world frame where nothing else is said."""

    position: Array
    quaternion: Array

    def __matmul__(self, inner: Pose) -> Pose:
        """Return `inner`, a pose in the frame that this pose places, in the frame of this pose."""
        position, quaternion = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(position, quaternion, *self, *inner)
        return Pose(position, quaternion)

    def inverse(self) -> Pose:
        """Return the pose that undoes this one."""
        position, quaternion = np.zeros(3), np.zeros(4)
        mujoco.mju_negPose(position, quaternion, *self)
        return Pose(position, quaternion)

    def raised(self, height: float) -> Pose:
        """Return the pose moved by `height`, in m, along the world's z axis."""
        return Pose(self.position + np.array([0.0, 0.0, height]), self.quaternion)

    def is_near(self, other: Pose) -> bool:
        """Say whether the two are one pose, but for rounding."""
        return bool(np.all(np.abs(self.position - other.position) < SAME)) and self.angle_to(other) < SAME

    def angle_to(self, other: Pose) -> float:
        """Return the angle between the two orientations, in rad."""
        return norm(self._turn_to(other))

    def towards(self, other: Pose, part: float) -> Pose:
        """Return the pose at `part`, 0 to 1, of the straight way with one constant turn to `other`."""
        quaternion = self.quaternion.copy()
        mujoco.mju_quatIntegrate(quaternion, self._turn_to(other), part)
        return Pose((1.0 - part) * self.position + part * other.position, quaternion)

    def _turn_to(self, other: Pose) -> Array:
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, other.quaternion, self.quaternion)
        return turn


def pose(position: ArrayLike, quaternion: ArrayLike) -> Pose:
    """Return a pose of its own arrays with the quaternion brought to unit length."""
    turned = np.array(quaternion, dtype=float)
    mujoco.mju_normalize4(turned)
    return Pose(np.array(position, dtype=float), turned)


def turned_about_z(yaw: float) -> Array:
    """Return the quaternion of a turn by `yaw`, in rad, about z."""
    return np.array([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)])


def yaw_of(quaternion: Array) -> float:
    """Return the turn about the world's z axis, in rad, that `quaternion` gives to its x axis."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.array([1.0, 0.0, 0.0]), quaternion)
    return math.atan2(turned[1], turned[0])


def pointing(direction: ArrayLike, yaw: float = 0.0) -> Array:
    """Return the quaternion that turns z to `direction` (3,), turned by `yaw`, in rad, about it."""
    target = np.array(direction, dtype=float)
    target /= norm(target)
    axis = np.cross([0.0, 0.0, 1.0], target)
    sine, cosine = norm(axis), float(target[2])
    # Straight down, any horizontal axis will do: x keeps the tool's y across the yaw.
    axis = np.array([1.0, 0.0, 0.0]) if sine < PARALLEL else axis / sine
    turn, result = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, axis, math.atan2(sine, cosine))
    mujoco.mju_mulQuat(result, turn, turned_about_z(yaw))
    return result
