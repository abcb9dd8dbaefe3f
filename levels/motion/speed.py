"""Limits of a path's parameter s: joint limits seen along the path, and the speeds that they
permit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.motion.path import PathBounds
from rack.levels.robot.limits import Limits

REACHABLE_PART = 1.0 - 1e-7
"""Part of a reachable change of speed that is used: at the exact limit, rounding decides whether it
is reachable."""
MIN_ACCELERATION_PART = 1e-6
"""Acceleration or jerk below this part of the speed, in 1/s or 1/s2, counts as none."""
SMALLEST_LINEAR_TERM = 1e-12
"""A cubic with a smaller linear coefficient is solved without it."""


class SpeedLimits(NamedTuple):
    """Limits of ds/dt and its derivatives, in rad/s, rad/s2, rad/s3; acceleration 0: constant
    speed."""

    speed: float
    acceleration: float
    jerk: float


def speed_limits(piece: PathBounds, limits: Limits, share: float) -> SpeedLimits:
    """Return limits of s that keep every joint within `limits` on a piece with the given bounds,
    (joints,) each.

    The joints move with q' ds, q'' ds^2 + q' dds and q''' ds^3 + 3 q'' ds dds + q' ddds. `share` (0
    to 1) is the part used of the highest speed that the bend of a curve permits: a smaller share
    leaves more to accelerate with.
    """
    first, second, third = piece
    velocity = limits.velocity
    acceleration = limits.acceleration
    jerk = limits.jerk
    curved = bool(second.any())
    speed = least_ratio(velocity, first)
    if curved:
        speed = min(
            speed,
            share * math.sqrt(least_ratio(acceleration, second)),
            share * math.cbrt(least_ratio(jerk, third)),
        )
    left = np.maximum(acceleration - second * speed**2, 0.0)
    left_jerk = np.maximum(jerk - third * speed**3, 0.0)
    most = least_ratio(left, first)
    if curved:
        most = min(most, 0.5 * least_ratio(left_jerk, 3.0 * second * speed))
    change = least_ratio(np.maximum(left_jerk - 3.0 * second * speed * most, 0.0), first)
    if min(most, change) < MIN_ACCELERATION_PART * speed:
        return SpeedLimits(speed, 0.0, 0.0)
    return SpeedLimits(speed, most, change)


def reachable_speed(start: float, length: float, limits: SpeedLimits) -> float:
    """Return the highest speed reachable from speed `start` over `length` rad, both without
    acceleration, in rad/s.

    By symmetry it is also the highest speed from which `start` can still be reached.
    """
    a = limits.acceleration
    j = limits.jerk
    if a <= 0.0:
        return min(start, limits.speed)
    change = _root_of_cubic(2.0 * start, length * math.sqrt(j)) ** 2
    if change > a * a / j:
        # (2 start + change) / 2 * (change / a + a / j) = length
        linear = 2.0 * start + a * a / j
        constant = 2.0 * a * (start * a / j - length)
        change = 0.5 * (-linear + math.sqrt(linear * linear - 4.0 * constant))
    return min(start + change * REACHABLE_PART, limits.speed)


def boundary_speeds(lengths: Sequence[float], limits: Sequence[SpeedLimits]) -> list[float]:
    """Return the highest speeds at the ends of consecutive stretches, from rest to rest, in
    rad/s."""
    speeds = [0.0]
    for k, (length, limit) in enumerate(zip(lengths, limits, strict=True)):
        following = limits[k + 1].speed if k + 1 < len(limits) else 0.0
        speeds.append(min(reachable_speed(speeds[k], length, limit), following))
    for k in range(len(lengths) - 1, -1, -1):
        speeds[k] = min(speeds[k], reachable_speed(speeds[k + 1], lengths[k], limits[k]))
    return speeds


def least_ratio(room: Array, rate: Array) -> float:
    """Return the least room / rate over the joints that move; infinite when none does."""
    return float(np.divide(room, rate, out=np.full(len(rate), np.inf), where=rate > 0.0).min())


def _root_of_cubic(p: float, q: float) -> float:
    """Return the real root of x^3 + p x = q for p, q >= 0 (hyperbolic form of Cardano's)."""
    if p < SMALLEST_LINEAR_TERM:
        return math.cbrt(q)
    r = math.sqrt(p / 3.0)
    return 2.0 * r * math.sinh(math.asinh(q / (2.0 * r**3)) / 3.0)
