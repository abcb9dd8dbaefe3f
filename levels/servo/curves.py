"""Curves that the set point follows in joint space. Times are seconds from the curve's start; arrays are (joints,)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from rack.levels.algebra import Array


class Motion(NamedTuple):
    """Joint positions, rad, velocities, rad/s, and accelerations, rad/s2, (joints,) each."""

    position: Array
    velocity: Array
    acceleration: Array


class Curve(Protocol):
    """A motion in time."""

    def at(self, time_s: float) -> Motion:
        """Return the motion at `time_s`."""


class Hermite:
    """The cubic between two points with given velocities, `duration_s` apart."""

    def __init__(self, start: Array, start_velocity: Array, end: Array, end_velocity: Array, duration_s: float) -> None:
        first, second = start_velocity * duration_s, end_velocity * duration_s
        way = end - start
        self._duration_s = duration_s
        self._coefficients = (start, first, 3.0 * way - 2.0 * first - second, first + second - 2.0 * way)

    def at(self, time_s: float) -> Motion:
        """Return the motion at `time_s`, from 0 to the duration."""
        c0, c1, c2, c3 = self._coefficients
        h, u = self._duration_s, time_s / self._duration_s
        position = c0 + u * (c1 + u * (c2 + u * c3))
        velocity = (c1 + u * (2.0 * c2 + 3.0 * u * c3)) / h
        return Motion(position, velocity, (2.0 * c2 + 6.0 * u * c3) / (h * h))

    def hardest(self) -> Array:
        """Return the largest |acceleration| on the curve, rad/s2: it is at one of the ends."""
        _, _, c2, c3 = self._coefficients
        return np.asarray(np.maximum(np.abs(2.0 * c2), np.abs(2.0 * c2 + 6.0 * c3)) / self._duration_s**2)


class Ramp:
    """From a velocity to rest, all joints at the same time, so that they stay on a straight line; then rest."""

    def __init__(self, start: Array, velocity: Array, acceleration: Array) -> None:
        """Decelerate no joint harder than its `acceleration`, rad/s2."""
        self.duration_s = float(np.max(np.abs(velocity) / acceleration))
        self._start, self._velocity = start, velocity
        self._end = start + 0.5 * velocity * self.duration_s
        self._rest = np.zeros_like(start)

    def at(self, time_s: float) -> Motion:
        """Return the motion at `time_s` from 0 on."""
        if time_s >= self.duration_s:
            return Motion(self._end, self._rest, self._rest)
        braking = self._velocity / self.duration_s
        position = self._start + time_s * (self._velocity - 0.5 * time_s * braking)
        return Motion(position, self._velocity - time_s * braking, -braking)


class Decay:
    """A difference in position and velocity that decays: a quintic that ends with all derivatives zero; then 0."""

    def __init__(self, position: Array, velocity: Array, fastest: Array, hardest: Array) -> None:
        """Last as long as it takes to add at most about `fastest`, rad/s, and `hardest`, rad/s2, to a motion."""
        # Peaks of the quintic over a time T: 1.875 p / T in velocity; 5.774 p / T^2 + 3.94 v / T in acceleration.
        linear = 3.94 * np.abs(velocity)
        by_acceleration = (linear + np.sqrt(linear**2 + 4.0 * 5.774 * hardest * np.abs(position))) / (2.0 * hardest)
        self.duration_s = float(max(np.max(1.875 * np.abs(position) / fastest), np.max(by_acceleration)))
        p, w = position, velocity * self.duration_s
        self._coefficients = (p, w, -10.0 * p - 6.0 * w, 15.0 * p + 8.0 * w, -6.0 * p - 3.0 * w)
        self._zero = np.zeros_like(position)

    def at(self, time_s: float) -> Motion:
        """Return the remaining difference at `time_s` from 0 on."""
        if time_s >= self.duration_s:
            return Motion(self._zero, self._zero, self._zero)
        c0, c1, c3, c4, c5 = self._coefficients
        h, u = self.duration_s, time_s / self.duration_s
        position = c0 + u * (c1 + u * u * (c3 + u * (c4 + u * c5)))
        velocity = (c1 + u * u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5))) / h
        return Motion(position, velocity, u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5)) / (h * h))


class Passage:
    """From rest to rest at another place, all joints at the same time, straight in joint space; then rest."""

    def __init__(self, start: Array, end: Array, fastest: Array, hardest: Array) -> None:
        """Last as long as it takes to keep every joint within `fastest`, rad/s, and `hardest`, rad/s2."""
        self._end = end
        self._left = Decay(start - end, np.zeros_like(start), fastest, hardest)

    def at(self, time_s: float) -> Motion:
        """Return the motion at `time_s` from 0 on."""
        left = self._left.at(time_s)
        return Motion(self._end + left.position, left.velocity, left.acceleration)
