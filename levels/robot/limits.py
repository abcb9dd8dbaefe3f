"""Limits of an arm's joints, from config and model: what motion is planned within, and what is never exceeded."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import RobotError
from rack.levels.tables import RobotConfig

VELOCITY_ROOM = 0.05
"""Part of a velocity limit that planned motion leaves free, so that tracking it does not run into the limit gate."""
POSITION_ROOM_RAD = 0.005
"""What planned motion keeps from the ends of a joint's range, for the same reason."""


@dataclass(frozen=True)
class Bounds:
    """What the arm never exceeds, fault or not: the limits as config and model give them.

    Slides have m and N where hinges have rad and N m.

    - `position`: (joints, 2), low and high, rad; -inf and inf for a joint without.
    - `velocity`: (joints,), both ways, rad/s. `torque`: (joints,), both ways, N m.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What motion is planned within: the bounds, less some room to track it, and the config's smoothness.

    `position` (joints, 2), rad; `velocity`, `acceleration`, `jerk` (joints,), both ways, rad/s, rad/s2, rad/s3;
    `torque` (joints,), N m.
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    jerk: NDArray[np.float64]
    torque: NDArray[np.float64]


EDGE_TIMING_S = 0.1
"""A drive's velocity is as coarse as its position over this time: it times the encoder's edges, which is far finer than
the difference of two samples (of 1 mrad in 2.5 ms: 0.4 rad/s) and without the lag of a filter behind one."""
PRESSING = 0.2
"""Part of a torque limit that a contact takes at most where a task means one, as when a part is set down: a third more
than tasks show."""
RESTING = 0.1
"""The same while an arm that holds a part hardly moves: dry friction may hide the push at all joints but one."""
TURNING_JOINTS = 2
"""Joints that turn, at which a push shows: fewer, and the arm hardly moves."""
SIGMAS = 6.0
"""Standard deviations of noise that a monitor allows for: less than one sample in a billion is farther off."""


@dataclass(frozen=True)
class Encoders:
    """What the joints' sensors resolve, (joints,) each: `resolution` and `noise` of positions, rad.

    Of velocities, rad/s, they are these over `EDGE_TIMING_S`. `off` and `speed_off`: how far from the truth a good
    sample may be, rad and rad/s.
    """

    resolution: NDArray[np.float64]
    noise: NDArray[np.float64]

    @classmethod
    def of(cls, robot: RobotConfig) -> Encoders:
        """Return those of a `[robot]` table."""
        joints, sensors = len(robot.joints), robot.sensors
        return cls(np.broadcast_to(sensors.resolution, joints), np.broadcast_to(sensors.noise, joints))

    @property
    def exact(self) -> bool:
        """Whether samples are the truth."""
        return not (self.resolution.any() or self.noise.any())

    @property
    def off(self) -> NDArray[np.float64]:
        """Largest error of a good position, (joints,), rad."""
        return np.asarray(0.5 * self.resolution + SIGMAS * self.noise)

    @property
    def speed_off(self) -> NDArray[np.float64]:
        """Largest error of a good velocity, (joints,), rad/s."""
        return self.off / EDGE_TIMING_S


def joint_bounds(
    model: mujoco.MjModel, joints: NDArray[np.int_], robot: RobotConfig, torque: NDArray[np.float64]
) -> Bounds:
    """Return the bounds; of a position range in both config and model the tighter end holds.

    Raises `RobotError` for a range that is empty.
    """
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf])
    if robot.position is not None:
        given = np.array(robot.position)
        ranges = np.stack((np.maximum(ranges[:, 0], given[:, 0]), np.minimum(ranges[:, 1], given[:, 1])), axis=1)
    for name, (low, high) in zip(robot.joints, ranges, strict=True):
        if not high - low > 2 * POSITION_ROOM_RAD:
            raise RobotError(f"robot.position: joint '{name}' has no room from {low:g} to {high:g} rad")
    return Bounds(position=ranges, velocity=np.array(robot.velocity), torque=torque)


def planned_limits(bounds: Bounds, robot: RobotConfig) -> Limits:
    """Return the limits of planned motion."""
    return Limits(
        position=bounds.position + np.array([POSITION_ROOM_RAD, -POSITION_ROOM_RAD]),
        velocity=bounds.velocity * (1.0 - VELOCITY_ROOM),
        acceleration=np.array(robot.acceleration),
        jerk=np.array(robot.jerk),
        torque=bounds.torque,
    )
