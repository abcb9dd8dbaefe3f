"""Poses: position and orientation of a body, the tool or a frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rack.levels.algebra import Array, norm

MAX_DIFFERENCE = 1e-6
"""Poses closer than this, in m and in rad, count as equal."""
MAX_PARALLEL_SINE = 1e-9
"""Two unit vectors whose cross product is shorter than this count as parallel."""


class Pose(NamedTuple):
    """Position and orientation, in the world frame unless stated otherwise."""

    position: Array  # (3,), m
    quaternion: Array  # (4,), unit length, as w, x, y, z

    def __matmul__(self, inner: Pose) -> Pose:
        """Return the composition: `inner`, which is relative to this pose, in the outer frame."""
        outer = Pose(np.zeros(3), np.zeros(4))
        mujoco.mju_mulPose(*outer, *self, *inner)
        return outer

    def inverse(self) -> Pose:
        """Return the inverse: the pose of the reference frame relative to this pose."""
        inverse = Pose(np.zeros(3), np.zeros(4))
        mujoco.mju_negPose(*inverse, *self)
        return inverse

    def raise_by(self, height: float) -> Pose:
        """Return the pose moved by `height`, in m, along the world's z axis."""
        return Pose(self.position + np.array([0.0, 0.0, height]), self.quaternion)

    def is_near(self, other: Pose) -> bool:
        """Return True if the two poses are equal up to rounding."""
        return (
            bool(np.all(np.abs(self.position - other.position) < MAX_DIFFERENCE))
            and self.compute_angle(other) < MAX_DIFFERENCE
        )

    def compute_angle(self, other: Pose) -> float:
        """Return the angle between the two orientations, in rad."""
        return norm(self._compute_turn(other))

    def rotate_vector(self, vector: ArrayLike) -> Array:
        """Return a vector, (3,), that is given in this frame, in the outer frame."""
        rotated = np.zeros(3)
        mujoco.mju_rotVecQuat(rotated, np.array(vector, dtype=float), self.quaternion)
        return rotated

    def compute_error(self, target: Pose) -> Array:
        """Return the distance, m, then the rotation, rad, from this pose to `target`, (6,)."""
        return np.concatenate(
            (target.position - self.position, self.rotate_vector(self._compute_turn(target)))
        )

    def interpolate_to(self, other: Pose, part: float) -> Pose:
        """Interpolate to another pose, linearly in position and in the angle of rotation.

        Args:
            other: Pose at the end of the motion.
            part: Fraction of the motion, 0 to 1.
        """
        quaternion = self.quaternion.copy()
        mujoco.mju_quatIntegrate(quaternion, self._compute_turn(other), part)
        return Pose((1.0 - part) * self.position + part * other.position, quaternion)

    def _compute_turn(self, other: Pose) -> Array:
        """Return the rotation from this orientation to `other`, a rotation vector (3,) in rad."""
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, other.quaternion, self.quaternion)
        return turn


def make_pose(position: ArrayLike, quaternion: ArrayLike) -> Pose:
    """Return a pose with a copy of the position and a normalized copy of the quaternion."""
    turned = np.array(quaternion, dtype=float)
    mujoco.mju_normalize4(turned)
    return Pose(np.array(position, dtype=float), turned)


def read_site_pose(data: mujoco.MjData, site: int) -> Pose:
    """Return the pose of a site in simulation data."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
    return Pose(data.site_xpos[site].copy(), quaternion)


def build_yaw_quaternion(yaw: float) -> Array:
    """Return the quaternion of a rotation about the z axis by `yaw`, in rad."""
    return np.array([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)])


def compute_yaw(quaternion: Array) -> float:
    """Return the angle in rad by which `quaternion` turns the x axis about the world's z axis."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.array([1.0, 0.0, 0.0]), quaternion)
    return math.atan2(turned[1], turned[0])


def build_pointing_quaternion(direction: ArrayLike, yaw: float = 0.0) -> Array:
    """Return the orientation of a frame whose z axis has a given direction.

    Args:
        direction: Direction of the z axis, (3,), of any length.
        yaw: Angle by which the frame is turned about its z axis, rad.
    """
    target = np.array(direction, dtype=float)
    target /= norm(target)
    axis = np.cross([0.0, 0.0, 1.0], target)
    sine = norm(axis)
    cosine = float(target[2])
    # For a direction straight down any horizontal axis is possible. With x, the y axis of the tool
    # stays perpendicular to the direction of the yaw.
    axis = np.array([1.0, 0.0, 0.0]) if sine < MAX_PARALLEL_SINE else axis / sine
    turn = np.zeros(4)
    result = np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, axis, math.atan2(sine, cosine))
    mujoco.mju_mulQuat(result, turn, build_yaw_quaternion(yaw))
    return result
