"""Limits of an arm's joints, from config and model, and the resolution of their encoders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints
from rack.levels.errors import RobotError
from rack.levels.tables import RobotConfig, SensorConfig

VELOCITY_ROOM = 0.05
"""Part of a velocity limit that planned motion leaves free, so that tracking stays clear of the
limit gate."""
POSITION_ROOM_RAD = 0.005
"""Distance that planned motion keeps from the ends of a joint's range, for the same reason."""
EDGE_TIMING_S = 0.1
"""A drive's velocity is as coarse as its position over this time: it times the encoder's edges,
which is far finer than the difference of two samples (of 1 mrad in 2.5 ms: 0.4 rad/s) and has no
filter's lag."""
MAX_CONTACT_PART = 0.2
"""Largest part of a torque limit that an intended contact takes, as when a part is set down: a
third more than observed in tasks."""
MAX_RESTING_CONTACT_PART = 0.1
"""The same for an arm that holds a part and hardly moves: dry friction may hide the push at all
joints but one."""
MIN_TURNING_JOINTS = 2
"""Fewest turning joints at which an arm moves enough for a push to show."""
PATIENCE_PART = 0.25
"""Largest part by which motors that keep their last torque may add to a stop from full speed; see
`patience_of`."""
LEAST_CYCLES = 2
"""Torque cycles for which motors keep their last torque by default, at least: one late cycle must
not brake the arm."""
MAX_PATIENCE_S = 0.01
"""Longest time by default, however slow or weak the arm: no torque for so long is no stall of a
cycle or two."""
SIGMAS = 6.0
"""Standard deviations of noise that a monitor allows for: less than one sample in a billion exceeds
them."""


@dataclass(frozen=True)
class Bounds:
    """Limits that the arm never exceeds, fault or not: as config and model give them.

    Slides have m and N where hinges have rad and N m.
    """

    position: Array  # (joints, 2), rad: low and high; -inf and inf for a joint without
    velocity: Array  # (joints,), rad/s, both ways
    torque: Array  # (joints,), N m, both ways


@dataclass(frozen=True)
class Limits:
    """Limits of planned motion: the bounds, less some room for tracking, and the config's
    smoothness.
    """

    position: Array  # (joints, 2), rad: low and high
    velocity: Array  # (joints,), rad/s, both ways
    acceleration: Array  # (joints,), rad/s2, both ways
    jerk: Array  # (joints,), rad/s3, both ways


@dataclass(frozen=True)
class Encoders:
    """Resolution and noise of the joints' sensors; of velocities, rad/s, they are these over
    `EDGE_TIMING_S`.
    """

    resolution: Array  # (joints,), rad: step of a position
    noise: Array  # (joints,), rad: standard deviation of a position
    latency_ticks: int = 0  # age of a sample when it is read
    off_late: Array | float = 0.0  # (joints,), rad: largest error due to that
    speed_off_late: Array | float = 0.0  # (joints,), rad/s: likewise
    offset: Array | None = None  # (joints,), rad: added to what the drives give

    @classmethod
    def of(cls, robot: RobotConfig, tick_s: float, default: SensorConfig | None = None) -> Encoders:
        """Return the encoders of a `[robot]` table; if it does not say, `default`, or exact ones.

        A sample is brought to the present by the arm's equation of motion, which may be wrong by as
        much as the acceleration that is planned with.
        """
        joints = len(robot.joints)
        sensors = robot.sensors or default or SensorConfig()
        offset = robot.calibration.offset
        late_s = robot.latency_ticks * tick_s
        wrong = np.array(robot.acceleration)
        return cls(
            np.broadcast_to(sensors.resolution, joints),
            np.broadcast_to(sensors.noise, joints),
            robot.latency_ticks,
            0.5 * wrong * late_s**2,
            wrong * late_s,
            None if offset is None else np.array(offset),
        )

    @property
    def exact(self) -> bool:
        """Whether samples are the truth."""
        return not (self.resolution.any() or self.noise.any())

    @property
    def off(self) -> Array:
        """Largest error of a good position, (joints,), rad."""
        return self._off_sampled + self.off_late

    @property
    def speed_off(self) -> Array:
        """Largest error of a good velocity, (joints,), rad/s."""
        return self._off_sampled / EDGE_TIMING_S + self.speed_off_late

    @property
    def _off_sampled(self) -> Array:
        return np.asarray(0.5 * self.resolution + SIGMAS * self.noise)


class MotorPatience(NamedTuple):
    """The time for which motors keep their last torque when none comes; then the brakes engage."""

    seconds: float
    least: int  # torque cycles that it lasts in any case

    def ticks(self, every: int, tick_s: float) -> int:
        """Return it in ticks: whole torque cycles of `every` ticks of `tick_s` each."""
        # A millionth of a cycle more: 5 ms are two cycles of 2.5 ms, whichever way those are
        # rounded.
        return every * max(int(self.seconds / (every * tick_s) + 1e-6), self.least)


def patience_of(robot: RobotConfig, bounds: Bounds, energy_j: float) -> MotorPatience:
    """Return the patience of an arm whose joints, all at full speed at home, have kinetic energy
    `energy_j`.

    By default it is the time in which a stop from full speed grows by at most `PATIENCE_PART`: by
    what the joints turn at that speed, of the angle in which the brakes stop them; and by what all
    motors put in at full torque, of the energy that the brakes take in any case. (The limits hold
    without it: the limit gate passes every tick.)
    """
    if robot.patience_ms is not None:
        return MotorPatience(robot.patience_ms * 1e-3, 1)
    stops_s = 0.5 * np.min(bounds.velocity / robot.acceleration)
    gains_s = energy_j / np.sum(bounds.torque * bounds.velocity)
    return MotorPatience(
        min(PATIENCE_PART * float(min(stops_s, gains_s)), MAX_PATIENCE_S), LEAST_CYCLES
    )


def joint_bounds(model: mujoco.MjModel, joints: Ints, robot: RobotConfig, torque: Array) -> Bounds:
    """Return the bounds; where config and model both limit a position, the tighter limit applies.

    Raises `RobotError` for an empty range.
    """
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf])
    if robot.position is not None:
        given = np.array(robot.position)
        ranges = np.stack(
            (np.maximum(ranges[:, 0], given[:, 0]), np.minimum(ranges[:, 1], given[:, 1])), axis=1
        )
    for name, (low, high) in zip(robot.joints, ranges, strict=True):
        if not high - low > 2 * POSITION_ROOM_RAD:
            raise RobotError(
                f"robot.position: joint '{name}' has no room from {low:g} to {high:g} rad"
            )
    return Bounds(position=ranges, velocity=np.array(robot.velocity), torque=torque)


def planned_limits(bounds: Bounds, robot: RobotConfig) -> Limits:
    """Return the limits of planned motion."""
    return Limits(
        position=bounds.position + np.array([POSITION_ROOM_RAD, -POSITION_ROOM_RAD]),
        velocity=bounds.velocity * (1.0 - VELOCITY_ROOM),
        acceleration=np.array(robot.acceleration),
        jerk=np.array(robot.jerk),
    )
