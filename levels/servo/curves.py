"""Curves that the set point follows in joint space.

Times are seconds from the start of the curve, arrays are (joints,).

Every curve is a table of seven rows: the coefficients of a polynomial in u = time / duration,
lowest first, and the joint positions at rest after its end. So one compiled function evaluates all
kinds of curves.
"""

from __future__ import annotations

import numpy as np

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for

REST = 6
"""Row of a curve's table that holds the joint positions at rest after its end."""


class Motion:
    """Positions, velocities and accelerations of the joints, in rad, rad/s and rad/s2.

    Each is a row of `table`, (joints,).
    """

    __slots__ = ("acceleration", "position", "table", "velocity")

    def __init__(self, table: Array) -> None:
        self.table = table  # (3, joints)
        self.position, self.velocity, self.acceleration = table


class SensedMotion:
    """Positions and velocities of the joints, in rad and rad/s: rows of `table`, (joints,) each."""

    __slots__ = ("position", "table", "velocity")

    def __init__(self, table: Array) -> None:
        self.table = table  # (2, joints)
        self.position, self.velocity = table


class Curve:
    """A motion of all joints over time. From `ends_s` on, the joints are at rest."""

    def __init__(self, *coefficients: Array, duration_s: float, rest: Array | None = None) -> None:
        """Take polynomial coefficients.

        Args:
            coefficients: Coefficients of u^0, u^1, ..., (joints,) each, rad.
            duration_s: Time at which u is 1.
            rest: Positions at rest after `duration_s`, (joints,), rad. None continues the
                polynomial.
        """
        self.table: Array = np.zeros((REST + 1, len(coefficients[0])))  # (7, joints), rad
        self.table[: len(coefficients)] = coefficients
        self.duration_s = duration_s
        self.ends_s = np.inf if rest is None else duration_s
        if rest is not None:
            self.table[REST] = rest

    def compute_motion(self, time_s: float) -> Motion:
        """Return the motion at `time_s`, which must be at least 0."""
        motion = Motion(np.zeros((3, self.table.shape[1])))
        set_motion.load_machine_code()(
            self.table, self.duration_s, self.ends_s, time_s, 0.0, motion.table
        )
        return motion


@compiled_for("f8[:,::1], f8, f8, f8, f8, f8[:,::1]")
def set_motion(
    table: Array, duration_s: float, ends_s: float, time_s: float, ahead_s: float, motion: Array
) -> None:
    """Evaluate a curve: position and velocity at one time, acceleration somewhat later.

    Args:
        table: Table of the curve, (7, joints).
        duration_s: Duration of the curve.
        ends_s: Time at which the joints rest, or infinity.
        time_s: Time for position and velocity.
        ahead_s: Time after `time_s` for the acceleration.
        motion: Output, (3, joints), rad, rad/s, rad/s2.
    """
    h = duration_s
    u = time_s / duration_s
    later = (time_s + ahead_s) / duration_s
    motion[:] = 0.0
    if not time_s < ends_s:
        motion[0] = table[REST]
        return
    for j in range(table.shape[1]):
        c0, c1, c2, c3, c4, c5 = table[:REST, j]
        motion[0, j] = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
        motion[1, j] = (c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h
        if time_s + ahead_s < ends_s:
            bend = 2.0 * c2 + later * (6.0 * c3 + later * (12.0 * c4 + later * 20.0 * c5))
            motion[2, j] = bend / (h * h)


class Bridge(Curve):
    """A cubic curve from the state on another curve to a given position and velocity."""

    def __init__(
        self, before: Curve, begin_s: float, end: tuple[Array, Array], duration_s: float
    ) -> None:
        """Leave `before` at its time `begin_s`, and reach `end` after `duration_s`.

        Args:
            before: Curve to leave.
            begin_s: Time on that curve.
            end: Position, rad, and velocity, rad/s, to reach.
            duration_s: Duration of the new curve.
        """
        motion = before.compute_motion(begin_s)
        position, velocity = end
        first = motion.velocity * duration_s
        second = velocity * duration_s
        distance = position - motion.position
        super().__init__(
            motion.position,
            first,
            3.0 * distance - 2.0 * first - second,
            first + second - 2.0 * distance,
            duration_s=duration_s,
        )

    def is_within(self, acceleration: Array) -> bool:
        """Return True if no joint exceeds its acceleration limit on this curve.

        The acceleration of a cubic is greatest at one of its ends.

        Args:
            acceleration: Acceleration limits, (joints,), rad/s2.
        """
        begin = 2.0 * self.table[2] / self.duration_s**2
        end = (2.0 * self.table[2] + 6.0 * self.table[3]) / self.duration_s**2
        return bool(np.all((np.abs(begin) <= acceleration) & (np.abs(end) <= acceleration)))


class Ramp(Curve):
    """A motion from a velocity to rest.

    All joints stop at the same time, so the arm stays on a straight line in joint space.
    """

    def __init__(self, start: Array, velocity: Array, acceleration: Array) -> None:
        """Decelerate as quickly as the limits permit.

        Args:
            start: Position at the start, (joints,), rad.
            velocity: Velocity at the start, (joints,), rad/s.
            acceleration: Acceleration limits, (joints,), rad/s2.
        """
        duration_s = float(np.max(np.abs(velocity) / acceleration))
        half = 0.5 * velocity * duration_s
        super().__init__(start, 2.0 * half, -half, duration_s=duration_s, rest=start + half)


class Decay(Curve):
    """A difference in position and velocity that decays to zero.

    It is a quintic that ends with zero velocity and acceleration.
    """

    def __init__(self, position: Array, velocity: Array, fastest: Array, hardest: Array) -> None:
        """Choose the duration so that the decay adds about `fastest` and `hardest` at most.

        Args:
            position: Initial difference, (joints,), rad.
            velocity: Its initial rate, (joints,), rad/s.
            fastest: Largest added velocity, (joints,), rad/s.
            hardest: Largest added acceleration, (joints,), rad/s2.
        """
        # The quintic over a time T peaks at 1.875 p / T in velocity, and at 5.774 p / T^2 +
        # 3.94 v / T in acceleration.
        linear = 3.94 * np.abs(velocity)
        by_acceleration = (
            linear + np.sqrt(linear**2 + 4.0 * 5.774 * hardest * np.abs(position))
        ) / (2.0 * hardest)
        duration_s = float(max(np.max(1.875 * np.abs(position) / fastest), np.max(by_acceleration)))
        p = position
        w = velocity * duration_s
        c3 = -10.0 * p - 6.0 * w
        c4 = 15.0 * p + 8.0 * w
        c5 = -6.0 * p - 3.0 * w
        super().__init__(
            p, w, np.zeros_like(p), c3, c4, c5, duration_s=duration_s, rest=np.zeros_like(p)
        )


class Passage(Decay):
    """A straight motion in joint space from rest to rest; all joints stop at the same time."""

    def __init__(self, start: Array, end: Array, fastest: Array, hardest: Array) -> None:
        """Move from `start` to `end`, (joints,), rad, as quickly as the limits permit.

        Args:
            start: Position at rest before the motion.
            end: Position at rest after it.
            fastest: Velocity limits, (joints,), rad/s.
            hardest: Acceleration limits, (joints,), rad/s2.
        """
        super().__init__(start - end, np.zeros_like(start), fastest, hardest)
        self.table[0] += end
        self.table[REST] += end
