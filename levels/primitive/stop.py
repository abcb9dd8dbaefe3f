"""A ramp to rest along a path: what a hold does."""

from __future__ import annotations

import numpy as np
import ruckig
from numpy.typing import NDArray

from rack.levels.primitive.path import COINCIDENT_RAD, BlendedPath
from rack.levels.primitive.speed import JointLimits, acceleration_room
from rack.levels.primitive.trajectory import Motion, Trajectory, calculated, joined

Array = NDArray[np.float64]

EFFORTS = ((1.0, 1.0), (0.6, 1.0), (0.6, 0.5), (0.35, 0.6), (0.35, 0.3), (0.2, 0.3), (0.2, 0.15), (0.1, 0.1))
"""Parts of a straight line's deceleration and jerk that are tried; a curve leaves less of both."""
INTERVALS = 24
"""Intervals of equal time in which the joint limits are checked."""
ROUNDING = 1e-6
REST_RAD_S = 1e-7
"""Motion slower than this rests."""


def make_stop(path: BlendedPath, limits: JointLimits, motion: Motion) -> Trajectory | None:
    """Make the shortest ramp found to rest along `path` from `motion` that keeps the joint limits.

    None: every one of them would break a limit or overrun the path. Motion may then follow its trajectory,
    which itself ends at rest, and ask again a cycle later. Bounded time, whatever the path.
    """
    if motion.ds < REST_RAD_S:
        return joined([], motion.s)
    most, jerk = acceleration_room(path.bounds.first[path.piece_at(motion.s)], limits)
    # Beyond a stop the path goes on in another direction: only rest may be there.
    end = next((s for s in path.stops if s > motion.s - COINCIDENT_RAD), path.length) + COINCIDENT_RAD
    for part, part_of_jerk in EFFORTS:
        stop = _ramp(motion, max(part * most, abs(motion.dds)), part_of_jerk * jerk)
        if stop.end <= end and _keeps(stop, path, limits):
            return stop
    return None


def _ramp(motion: Motion, acceleration: float, jerk: float) -> Trajectory:
    wanted = ruckig.InputParameter(1)
    wanted.control_interface = ruckig.ControlInterface.Velocity
    wanted.current_position, wanted.current_velocity = [motion.s], [motion.ds]
    wanted.current_acceleration = [motion.dds]
    wanted.max_acceleration, wanted.max_jerk = [acceleration], [jerk]
    return joined(calculated(wanted), motion.s)


def _keeps(stop: Trajectory, path: BlendedPath, limits: JointLimits) -> bool:
    """Say whether every joint keeps its limits, by bounds of motion and path over each interval of time."""
    switches = stop.sections[:, 0]
    times = _checked_times(stop)
    s, ds, dds = stop.states(times)
    jerk = np.abs(stop.sections[np.searchsorted(switches, times[:-1], side="right") - 1, 4])
    # Within an interval dds is linear and does not change its sign: the ends bound both dds and ds.
    most = np.maximum(np.abs(dds[:-1]), np.abs(dds[1:]))
    speed = np.maximum(ds[:-1], ds[1:])
    first, second, third = _bounds_over(path, s)
    speed, most, jerk = speed[:, None], most[:, None], jerk[:, None]
    cubed = speed * speed * speed  # of an array, ** 3 is not the same on every processor
    return bool(
        (ds > -ROUNDING).all()  # a jerk too small to take back the deceleration there is would turn the motion round
        and (first * speed <= limits.velocity * (1.0 + ROUNDING)).all()
        and (second * speed**2 + first * most <= limits.acceleration * (1.0 + ROUNDING)).all()
        and (third * cubed + 3.0 * second * speed * most + first * jerk <= limits.jerk * (1.0 + ROUNDING)).all()
    )


def _checked_times(stop: Trajectory) -> Array:
    """Return the ends of the intervals: evenly spread, and wherever jerk or the sign of dds changes."""
    start, dds, jerk = stop.sections[:, 0], stop.sections[:, 3], stop.sections[:, 4]
    until_zero = np.divide(-dds, jerk, out=np.zeros(len(jerk)), where=jerk != 0.0)
    zeros = np.clip(start + until_zero, start, np.append(start[1:], stop.duration))
    return np.unique(np.concatenate((start, zeros, np.linspace(0.0, stop.duration, INTERVALS + 1))))


def _bounds_over(path: BlendedPath, s: Array) -> tuple[Array, Array, Array]:
    """Return the bounds of the path's derivatives between consecutive `s`; (n - 1, joints) each."""
    last = len(path.breaks) - 2
    piece = np.clip(np.searchsorted(path.breaks, s, side="right") - 1, 0, last)
    low, high = piece[:-1], piece[1:]
    bounds = [bound[low] for bound in path.bounds]
    for k in range(1, int((high - low).max()) + 1):
        for total, bound in zip(bounds, path.bounds, strict=True):
            np.maximum(total, bound[np.minimum(low + k, high)], out=total)
    return bounds[0], bounds[1], bounds[2]
