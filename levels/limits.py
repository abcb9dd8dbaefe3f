"""Limits of an arm's joints, from the config and the model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from levels.errors import RobotError
from levels.robot import RobotConfig


@dataclass(frozen=True)
class Limits:
    """Limits of the joints. Slides have m and N where hinges have rad and N m.

    - `position`: (joints, 2), low and high, rad; -inf and inf for a joint without.
    - `velocity`, `acceleration`, `jerk`: (joints,), both ways, rad/s, rad/s2, rad/s3.
    - `torque`: (joints,), both ways, N m.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    jerk: NDArray[np.float64]
    torque: NDArray[np.float64]


def joint_limits(
    model: mujoco.MjModel, joints: NDArray[np.int_], robot: RobotConfig, torque: NDArray[np.float64]
) -> Limits:
    """Return the limits; of a position range in both config and model the tighter end holds.

    Raises `RobotError` for a range that is empty.
    """
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf])
    if robot.position is not None:
        given = np.array(robot.position)
        ranges = np.stack((np.maximum(ranges[:, 0], given[:, 0]), np.minimum(ranges[:, 1], given[:, 1])), axis=1)
    for name, (low, high) in zip(robot.joints, ranges, strict=True):
        if not low < high:
            raise RobotError(f"robot.position: joint '{name}' has no room from {low:g} to {high:g} rad")
    return Limits(
        position=ranges,
        velocity=np.array(robot.velocity),
        acceleration=np.array(robot.acceleration),
        jerk=np.array(robot.jerk),
        torque=torque,
    )
