"""Limits of an arm's joints, from config and model, and the errors of their encoders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, Ints
from rack.levels.errors import RobotError
from rack.levels.tables import RobotConfig, SensorConfig

VELOCITY_MARGIN = 0.05
"""Fraction of a velocity limit that planned motion leaves unused.

It keeps motion with tracking errors clear of the limit gate.
"""
POSITION_MARGIN_RAD = 0.005
"""Distance of planned motion from the ends of a joint's range, in rad.

It keeps motion with tracking errors clear of the limit gate.
"""
EDGE_TIMING_S = 0.1
"""Resolution of position divided by resolution of velocity, in s.

A drive times the encoder's edges. That is much finer than the difference of two samples (for 1 mrad
in 2.5 ms: 0.4 rad/s) and does not lag like a filter.
"""
MAX_CONTACT_FRACTION = 0.2
"""Largest fraction of a torque limit that an intended contact takes.

Setting down an object is such a contact. The value is a third more than observed in tasks.
"""
MAX_RESTING_CONTACT_FRACTION = 0.1
"""Largest such fraction for an arm that holds an object and hardly moves.

Dry friction may then hide the contact force in all joints except one.
"""
MIN_TURNING_JOINTS = 2
"""Minimum number of turning joints for a contact force to be noticeable."""
PATIENCE_FRACTION = 0.25
"""Largest fraction by which motors that keep their last torque may lengthen a stop.

The stop is from full speed; see `compute_patience`.
"""
MIN_PATIENCE_CYCLES = 2
"""Minimum number of torque cycles for which motors keep their last torque by default.

One late cycle must not engage the brakes.
"""
MAX_PATIENCE_S = 0.01
"""Longest default time, in s, for which motors keep their last torque.

Even for a slow or weak arm, a longer time without torques means more than one or two late cycles.
"""
NOISE_SIGMAS = 6.0
"""Standard deviations of noise that a monitor tolerates.

Less than one sample in a billion exceeds them.
"""


@dataclass(frozen=True)
class Bounds:
    """Limits from config and model that the arm must never exceed, even during a fault.

    Sliding joints have m and N where turning joints have rad and N m.
    """

    position: Array  # (joints, 2), rad: low and high, -inf and inf without limits
    velocity: Array  # (joints,), rad/s, in both directions
    torque: Array  # (joints,), N m, in both directions


@dataclass(frozen=True)
class Limits:
    """Limits of planned motion.

    They are the bounds with a margin for tracking errors, and the acceleration and jerk limits that
    the config states.
    """

    position: Array  # (joints, 2), rad: low and high
    velocity: Array  # (joints,), rad/s, in both directions
    acceleration: Array  # (joints,), rad/s2, in both directions
    jerk: Array  # (joints,), rad/s3, in both directions


@dataclass(frozen=True)
class Encoders:
    """Resolution, noise and latency of the joints' sensors.

    The resolution and noise of velocities, in rad/s, are these values divided by `EDGE_TIMING_S`.
    """

    resolution: Array  # (joints,), rad: step of a position
    noise: Array  # (joints,), rad: standard deviation of a position
    latency_ticks: int = 0  # age of a sample when it is read
    late_position_error: Array | float = 0.0  # (joints,), rad: largest error due to the age
    late_velocity_error: Array | float = 0.0  # (joints,), rad/s: largest error due to the age
    offset: Array | None = None  # (joints,), rad: added to the drives' samples. None for 0

    @classmethod
    def from_config(
        cls, robot: RobotConfig, tick_s: float, default: SensorConfig | None = None
    ) -> Encoders:
        """Return the encoders that `[robot]` describes.

        Delayed samples are extrapolated to the present with the arm's equation of motion. The error
        of the extrapolated acceleration is assumed to be at most the acceleration limit of planned
        motion.

        Args:
            robot: The `[robot]` table.
            tick_s: Duration of a tick, s.
            default: Encoders to use if the table describes none. None for exact encoders.
        """
        joints = len(robot.joints)
        sensors = robot.sensors or default or SensorConfig()
        offset = robot.calibration.offset
        late_s = robot.latency_ticks * tick_s
        error = np.array(robot.acceleration)  # (joints,), rad/s2
        return cls(
            np.broadcast_to(sensors.resolution, joints),
            np.broadcast_to(sensors.noise, joints),
            robot.latency_ticks,
            0.5 * error * late_s**2,
            error * late_s,
            None if offset is None else np.array(offset),
        )

    @property
    def is_exact(self) -> bool:
        """True if resolution and noise are zero."""
        return not (self.resolution.any() or self.noise.any())

    @property
    def position_error(self) -> Array:
        """Largest error of the position in a valid sample, (joints,), in rad."""
        return self._sampling_error + self.late_position_error

    @property
    def velocity_error(self) -> Array:
        """Largest error of the velocity in a valid sample, (joints,), in rad/s."""
        return self._sampling_error / EDGE_TIMING_S + self.late_velocity_error

    @property
    def _sampling_error(self) -> Array:
        """Largest position error due to resolution and noise, (joints,), in rad."""
        return np.asarray(0.5 * self.resolution + NOISE_SIGMAS * self.noise)


class MotorPatience(NamedTuple):
    """Time for which motors keep their last torque when no new one arrives.

    After this time the brakes engage.
    """

    seconds: float
    min_cycles: int  # minimum number of torque cycles

    def ticks(self, every: int, tick_s: float) -> int:
        """Return the time in ticks, rounded down to a multiple of the torque cycle.

        The result is at least `min_cycles` torque cycles.

        Args:
            every: Length of a torque cycle in ticks.
            tick_s: Duration of a tick, s.
        """
        # Adding a millionth makes 5 ms two cycles of 2.5 ms, in spite of rounding.
        return every * max(int(self.seconds / (every * tick_s) + 1e-6), self.min_cycles)


def compute_patience(robot: RobotConfig, bounds: Bounds, energy_j: float) -> MotorPatience:
    """Return how long the motors may keep applying their last torque when no new one arrives.

    The result is `robot.patience_ms` if the config gives it. Otherwise it is the longest time that
    lengthens a stop from full speed by at most `PATIENCE_FRACTION`, according to two criteria. The
    first compares the angle through which joints turn at full speed in this time with their
    stopping angle when the brakes engage. The second compares the energy that all motors add at
    full torque in this time with the kinetic energy that the brakes have to absorb anyway. (The
    limits do not depend on this time, because the limit gate checks the torque in every tick.)

    Args:
        robot: The `[robot]` table.
        bounds: Limits of the arm.
        energy_j: Kinetic energy of the arm at home with all joints at full speed, J.
    """
    if robot.patience_ms is not None:
        return MotorPatience(robot.patience_ms * 1e-3, 1)
    stops_s = 0.5 * np.min(bounds.velocity / robot.acceleration)
    gains_s = energy_j / np.sum(bounds.torque * bounds.velocity)
    return MotorPatience(
        min(PATIENCE_FRACTION * float(min(stops_s, gains_s)), MAX_PATIENCE_S), MIN_PATIENCE_CYCLES
    )


def find_joint_bounds(
    model: mujoco.MjModel, joints: Ints, robot: RobotConfig, torque: Array
) -> Bounds:
    """Return the bounds of the joints.

    Where config and model both limit a position, the tighter limit applies.

    Args:
        model: The compiled model.
        joints: The joints.
        robot: The `[robot]` table.
        torque: Torque limits, (joints,), N m.

    Raises:
        RobotError: A range is empty.
    """
    ranges = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf])
    if robot.position is not None:
        stated = np.array(robot.position)
        ranges = np.stack(
            (np.maximum(ranges[:, 0], stated[:, 0]), np.minimum(ranges[:, 1], stated[:, 1])), axis=1
        )
    for name, (low, high) in zip(robot.joints, ranges, strict=True):
        if not high - low > 2 * POSITION_MARGIN_RAD:
            raise RobotError(
                f"robot.position: joint '{name}' cannot move from {low:g} to {high:g} rad"
            )
    return Bounds(position=ranges, velocity=np.array(robot.velocity), torque=torque)


def compute_planned_limits(bounds: Bounds, robot: RobotConfig) -> Limits:
    """Return the limits of planned motion within `bounds`."""
    return Limits(
        position=bounds.position + np.array([POSITION_MARGIN_RAD, -POSITION_MARGIN_RAD]),
        velocity=bounds.velocity * (1.0 - VELOCITY_MARGIN),
        acceleration=np.array(robot.acceleration),
        jerk=np.array(robot.jerk),
    )
