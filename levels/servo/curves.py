"""Curves that the set point follows in joint space. Times are seconds from the curve's start;
arrays are (joints,).

Every curve is a table of seven rows: the coefficients of a polynomial in u = time / duration,
lowest first, and where the joints rest after it. So one compiled function gives the motion on any
of them.
"""

from __future__ import annotations

import numpy as np

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for

REST = 6
"""Row of a curve's table: where the joints rest after it."""


class Motion:
    """Joint positions, rad, velocities, rad/s, and accelerations, rad/s2, (joints,) each: the rows
    of `table`.
    """

    __slots__ = ("acceleration", "position", "table", "velocity")

    def __init__(self, table: Array) -> None:
        self.table = table  # (3, joints)
        self.position, self.velocity, self.acceleration = table


class SensedMotion:
    """Joint positions, rad, and velocities, rad/s, (joints,) each: the rows of `table`."""

    __slots__ = ("position", "table", "velocity")

    def __init__(self, table: Array) -> None:
        self.table = table  # (2, joints)
        self.position, self.velocity = table


class Curve:
    """A motion in time, for all joints, that goes over to rest at `ends_s`."""

    def __init__(self, *coefficients: Array, duration_s: float, rest: Array | None = None) -> None:
        """Take coefficients of u^0, u^1, ..., rad; without `rest`, rad, the motion goes on after
        `duration_s`.
        """
        self.table: Array = np.zeros((REST + 1, len(coefficients[0])))  # (7, joints), rad
        self.table[: len(coefficients)] = coefficients
        self.duration_s = duration_s
        self.ends_s = np.inf if rest is None else duration_s
        if rest is not None:
            self.table[REST] = rest

    def at(self, time_s: float) -> Motion:
        """Return the motion at `time_s` from 0 on."""
        motion = Motion(np.zeros((3, self.table.shape[1])))
        set_motion.load()(self.table, self.duration_s, self.ends_s, time_s, 0.0, motion.table)
        return motion


@compiled_for("f8[:,::1], f8, f8, f8, f8, f8[:,::1]")
def set_motion(
    table: Array, duration_s: float, ends_s: float, time_s: float, ahead_s: float, motion: Array
) -> None:
    """Set position, velocity and, `ahead_s` later, acceleration, (3, joints), to those on a
    curve.
    """
    h = duration_s
    u = time_s / duration_s
    later = (time_s + ahead_s) / duration_s
    moves = time_s < ends_s
    accelerates = time_s + ahead_s < ends_s
    for j in range(table.shape[1]):
        if not moves:
            motion[0, j] = table[REST, j]
            motion[1, j] = 0.0
            motion[2, j] = 0.0
            continue
        c0 = table[0, j]
        c1 = table[1, j]
        c2 = table[2, j]
        c3 = table[3, j]
        c4 = table[4, j]
        c5 = table[5, j]
        motion[0, j] = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
        motion[1, j] = (c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h
        acceleration = (2.0 * c2 + later * (6.0 * c3 + later * (12.0 * c4 + later * 20.0 * c5))) / (
            h * h
        )
        motion[2, j] = acceleration if accelerates else 0.0


class Bridge(Curve):
    """The cubic from the motion on another curve to a position and a velocity."""

    def __init__(
        self, before: Curve, begin_s: float, end: tuple[Array, Array], duration_s: float
    ) -> None:
        """Leave `before` at its `begin_s`; reach `end`, rad, rad/s, `duration_s` later."""
        motion = before.at(begin_s)
        position, velocity = end
        first = motion.velocity * duration_s
        second = velocity * duration_s
        way = position - motion.position
        super().__init__(
            motion.position,
            first,
            3.0 * way - 2.0 * first - second,
            first + second - 2.0 * way,
            duration_s=duration_s,
        )

    def is_within(self, acceleration: Array) -> bool:
        """Return whether no joint needs more than its `acceleration`, rad/s2: the need is greatest
        at one of the ends.
        """
        begin = 2.0 * self.table[2] / self.duration_s**2
        end = (2.0 * self.table[2] + 6.0 * self.table[3]) / self.duration_s**2
        return bool(np.all((np.abs(begin) <= acceleration) & (np.abs(end) <= acceleration)))


class Ramp(Curve):
    """From a velocity to rest, all joints at the same time, so that they stay on a straight line;
    then rest.
    """

    def __init__(self, start: Array, velocity: Array, acceleration: Array) -> None:
        """Decelerate no joint harder than its `acceleration`, rad/s2."""
        duration_s = float(np.max(np.abs(velocity) / acceleration))
        half = 0.5 * velocity * duration_s
        super().__init__(start, 2.0 * half, -half, duration_s=duration_s, rest=start + half)


class Decay(Curve):
    """A difference in position and velocity that decays: a quintic that ends with all derivatives
    zero; then 0.
    """

    def __init__(self, position: Array, velocity: Array, fastest: Array, hardest: Array) -> None:
        """Last as long as it takes to add at most about `fastest`, rad/s, and `hardest`, rad/s2, to
        a motion.
        """
        # Peaks of the quintic over a time T: 1.875 p / T in velocity; 5.774 p / T^2 + 3.94 v / T in
        # acceleration.
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
    """From rest to rest at another place, all joints at the same time, straight in joint space;
    then rest.
    """

    def __init__(self, start: Array, end: Array, fastest: Array, hardest: Array) -> None:
        """Last as long as it takes to keep every joint within `fastest`, rad/s, and `hardest`,
        rad/s2.
        """
        super().__init__(start - end, np.zeros_like(start), fastest, hardest)
        self.table[0] += end
        self.table[REST] += end
