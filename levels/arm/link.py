"""Samples, set points and states of drives, which pass between the servo level and an arm."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple, Protocol

from rack.levels.algebra import Array
from rack.levels.level import Finding


class DriveState(IntEnum):
    """State of an arm's drives: the CiA 402 states, reduced to what levels distinguish."""

    DISABLED = 0  # up to "switched on", without a request: no power, brakes engaged
    ENABLING = 1  # on the way to "operation enabled", including homing
    ENABLED = 2  # "operation enabled": torques act, unlike in "quick stop active"
    FAULT = 3  # "fault reaction active" and "fault", until `Arm.reset`


class Sensed(NamedTuple):
    """One sample of the arm's sensors.

    Joint values have the resolution and noise of the encoders.
    """

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    opening: float  # gripper joint, m; 0 without a gripper
    opening_velocity: float  # m/s
    tick: int  # tick of the sample; if older than the cycle's, there is no new sample


class JointTarget(NamedTuple):
    """Set points of the joints for the end of a cycle. Arrays are (joints,)."""

    position: Array  # rad
    velocity: Array  # rad/s; for velocity drives, corrected for the position error
    torque: Array  # N m: predicted for the motion, including the payload


class LimitViolation(NamedTuple):
    """Violation of a joint limit by a sample."""

    finding: Finding
    text: str  # description for the user


def copy_sample(sample: Sensed) -> Sensed:
    """Return a copy of a sample; its arrays stay valid when the next sample is taken."""
    return sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())


class Link(Protocol):
    """The connection between the servo level and an arm."""

    def sense(self) -> Sensed:
        """Return the newest sample. The arrays are valid until the next call."""

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques for one torque cycle.

        If a torque must not be applied (see `BrakedArm.refused`), the brakes engage instead.

        Args:
            torque: Joint torques, (joints,), N m.
            grip_force: Force of the gripper, N.

        Returns:
            The reason why the torque was refused, or None if it was applied.
        """

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and make the drives reach `target` at the end of the cycle.

        After the end of the cycle, the drives continue at the velocity of `target`. For
        `grip_force` and the result see `drive`.
        """
