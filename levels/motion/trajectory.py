"""Timing of a path: sections of constant jerk of its parameter s, and ramps to rest.

The limits of s follow from the joint limits, transformed along the path, and from the speeds that
they permit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import ruckig

from rack.levels.algebra import Array
from rack.levels.messages import SECTIONS_PER_LINE
from rack.levels.motion.path import COINCIDENT_RAD, BlendedPath, PathBounds
from rack.levels.robot.limits import Limits

SPEED_FRACTIONS = (1.0, 0.9, 0.75, 0.6)
"""Fractions of a curve's highest speed that are tried. The fastest trajectory is used."""
MIN_SECTION_S = 1e-12
"""Sections shorter than this are dropped."""
STOP_EFFORTS = (
    (1.0, 1.0),
    (0.6, 1.0),
    (0.6, 0.5),
    (0.35, 0.6),
    (0.35, 0.3),
    (0.2, 0.3),
    (0.2, 0.15),
    (0.1, 0.1),
)
"""Fractions of a straight line's deceleration and jerk that are tried for a stop.

A curve permits less of both.
"""
STOP_INTERVALS = 24
"""Number of intervals of equal time in which the joint limits of a stop are checked."""
LIMIT_ROUNDING = 1e-6
"""Fraction by which a stop may exceed a limit, to allow for rounding."""
MAX_REST_RAD_S = 1e-7
"""Speed below which motion counts as rest, in rad/s."""

Section = tuple[float, float, float, float, float]
"""Duration, s, then s, ds and dds at the start, and the constant jerk."""


class PathState(NamedTuple):
    """Path parameter s and its derivatives by time, in rad, rad/s and rad/s2."""

    s: float
    ds: float
    dds: float


REACHABLE_FRACTION = 1.0 - 1e-7
"""Fraction of a reachable change of speed that is used.

At the exact limit, rounding would decide whether the change is reachable.
"""
MIN_ACCELERATION_RATIO = 1e-6
"""Ratio of acceleration or jerk to speed, 1/s or 1/s2, below which they count as 0."""
SMALLEST_LINEAR_TERM = 1e-12
"""Linear coefficient of a cubic below which it is ignored."""


class SpeedLimits(NamedTuple):
    """Limits of ds/dt and its derivatives, in rad/s, rad/s2 and rad/s3.

    If the acceleration is 0, the speed is constant.
    """

    speed: float
    acceleration: float
    jerk: float


def compute_speed_limits(piece: PathBounds, limits: Limits, share: float) -> SpeedLimits:
    """Return limits of ds/dt on a piece of a path that keep all joints within their limits.

    A joint has the velocity q' ds, the acceleration q'' ds^2 + q' dds and the jerk
    q''' ds^3 + 3 q'' ds dds + q' ddds.

    Args:
        piece: Bounds of the derivatives on the piece, (joints,) each.
        limits: Limits of the joints.
        share: Fraction, 0 to 1, of the highest speed that the curvature of the path permits. A
            smaller fraction leaves more of the limits for acceleration along the path.
    """
    first, second, third = piece
    # On a straight piece, the ratios to `second` and `third` are infinite.
    speed = min(
        compute_least_ratio(limits.velocity, first),
        share * math.sqrt(compute_least_ratio(limits.acceleration, second)),
        share * math.cbrt(compute_least_ratio(limits.jerk, third)),
    )
    acceleration_left = np.maximum(limits.acceleration - second * speed**2, 0.0)
    jerk_left = np.maximum(limits.jerk - third * speed**3, 0.0)
    max_acceleration = min(
        compute_least_ratio(acceleration_left, first),
        0.5 * compute_least_ratio(jerk_left, 3.0 * second * speed),
    )
    max_jerk = compute_least_ratio(
        np.maximum(jerk_left - 3.0 * second * speed * max_acceleration, 0.0), first
    )
    if min(max_acceleration, max_jerk) < MIN_ACCELERATION_RATIO * speed:
        return SpeedLimits(speed, 0.0, 0.0)
    return SpeedLimits(speed, max_acceleration, max_jerk)


def compute_reachable_speed(start: float, length: float, limits: SpeedLimits) -> float:
    """Return the highest speed, in rad/s, that is reachable from a given speed over a length.

    The acceleration is 0 at both ends. By symmetry this is also the highest speed from which
    `start` can be reached.

    Args:
        start: Speed at the start, rad/s.
        length: Length, rad.
        limits: Limits of the speed.
    """
    a = limits.acceleration
    j = limits.jerk
    if a <= 0.0:
        return min(start, limits.speed)
    change = _solve_cubic(2.0 * start, length * math.sqrt(j)) ** 2
    if change > a * a / j:
        # (2 start + change) / 2 * (change / a + a / j) = length
        linear = 2.0 * start + a * a / j
        constant = 2.0 * a * (start * a / j - length)
        change = 0.5 * (-linear + math.sqrt(linear * linear - 4.0 * constant))
    return min(start + change * REACHABLE_FRACTION, limits.speed)


def compute_boundary_speeds(lengths: Sequence[float], limits: Sequence[SpeedLimits]) -> list[float]:
    """Return the highest possible speeds at the ends of consecutive stretches of a path, in rad/s.

    The motion starts and ends at rest. `lengths` are in rad. Each stretch has an entry in `limits`.
    """
    speeds = [0.0]
    for k, (length, limit) in enumerate(zip(lengths, limits, strict=True)):
        following = limits[k + 1].speed if k + 1 < len(limits) else 0.0
        speeds.append(min(compute_reachable_speed(speeds[k], length, limit), following))
    for k in reversed(range(len(lengths))):
        speeds[k] = min(speeds[k], compute_reachable_speed(speeds[k + 1], lengths[k], limits[k]))
    return speeds


def compute_least_ratio(room: Array, rate: Array) -> float:
    """Return the smallest room / rate of all joints with a rate above 0.

    Return infinity if no joint has a rate above 0.
    """
    return float(np.divide(room, rate, out=np.full(len(rate), np.inf), where=rate > 0.0).min())


def _solve_cubic(p: float, q: float) -> float:
    """Return the real root of x^3 + p x = q for p, q >= 0 (Cardano's hyperbolic form)."""
    if p < SMALLEST_LINEAR_TERM:
        return math.cbrt(q)
    r = math.sqrt(p / 3.0)
    return 2.0 * r * math.sinh(math.asinh(q / (2.0 * r**3)) / 3.0)


class Trajectory:
    """Motion along a path as sections of constant jerk, ending at rest.

    It may start from rest or from motion.
    """

    def __init__(self, sections: Array, duration: float) -> None:
        # (n, 5), n >= 1: start time in s; then s, ds, dds and jerk of the path parameter.
        self.sections = sections
        self.duration = duration  # s
        self.begin = float(sections[0, 1])  # path parameter at the start, rad
        self.end = self.evaluate_at(duration).s  # path parameter at the end, rad

    def evaluate_at(self, time_s: float) -> PathState:
        """Return the state `time_s` after the start. The time is clamped to the duration."""
        time_s = min(max(time_s, 0.0), self.duration)
        k = int(np.searchsorted(self.sections[:, 0], time_s, side="right")) - 1
        start, *state = self.sections[max(k, 0)].tolist()
        return PathState(*_integrate_jerk(time_s - start, *state))

    def evaluate_states(self, times_s: Array) -> tuple[Array, Array, Array, Array]:
        """Return s, ds, dds and jerk, (n,) each, at `times_s`, (n,), all within the duration."""
        row = self.sections[np.searchsorted(self.sections[:, 0], times_s, side="right") - 1]
        return *_integrate_jerk(times_s - row[:, 0], *row[:, 1:].T), row[:, 4]

    def stretch_by(self, factor: float) -> Trajectory:
        """Return the same motion slowed down by `factor`, which must be at least 1.

        The result keeps all limits that this motion keeps.
        """
        powers = np.array([factor, 1.0, 1.0 / factor, 1.0 / factor**2, 1.0 / factor**3])
        return Trajectory(self.sections * powers, self.duration * factor)


def _integrate_jerk(t: Any, s: Any, ds: Any, dds: Any, jerk: Any) -> tuple[Any, Any, Any]:
    """Return s, ds and dds after time `t` under constant jerk; arguments are numbers or arrays."""
    return (
        s + t * (ds + t * (dds / 2.0 + t * jerk / 6.0)),
        ds + t * (dds + t * jerk / 2.0),
        dds + t * jerk,
    )


def make_trajectory(path: BlendedPath, limits: Limits, begin: float = 0.0) -> Trajectory:
    """Compute a fast motion from rest to rest at the end of a path.

    The motion also comes to rest at the stops of the path. Joint velocity, acceleration and jerk
    keep the limits everywhere, because the motion is computed from analytic bounds of the path
    instead of samples. The result has at most `SECTIONS` sections.

    Args:
        path: The path.
        limits: Limits of the joints.
        begin: Path parameter at the start, rad.
    """
    stops = [s for s in path.stops if s > begin + COINCIDENT_RAD]
    marks = [min(begin, path.length), *stops, path.length]
    rows: list[Section] = []
    for start, end in pairwise(marks):
        if end - start > COINCIDENT_RAD:
            rows += _find_fastest(path, start, end, limits)
    return _join_sections(rows, marks[0])


def make_stop(path: BlendedPath, limits: Limits, state: PathState) -> Trajectory | None:
    """Compute a short ramp to rest along a path, within the joint limits.

    The computing time is bounded for every path.

    Args:
        path: The path.
        limits: Limits of the joints.
        state: State at the start of the ramp.

    Returns:
        The shortest ramp found. None if every ramp tried would exceed a limit or the end of the
        path. In that case the motion can follow its trajectory, which also ends at rest, and try
        again in the next cycle.
    """
    if state.ds < MAX_REST_RAD_S:
        return _join_sections([], state.s)
    rate = path.bounds.first[path.find_pieces(state.s)]
    max_acceleration = compute_least_ratio(limits.acceleration, rate)
    max_jerk = compute_least_ratio(limits.jerk, rate)
    # The motion has to come to rest at a stop, where the path changes its direction.
    end = (
        next((s for s in path.stops if s > state.s - COINCIDENT_RAD), path.length) + COINCIDENT_RAD
    )
    for fraction, jerk_fraction in STOP_EFFORTS:
        request = _build_ruckig_input(
            state, max(fraction * max_acceleration, abs(state.dds)), jerk_fraction * max_jerk
        )
        request.control_interface = ruckig.ControlInterface.Velocity
        stop = _join_sections(_run_ruckig(request), state.s)
        if stop.end <= end and _is_within_limits(stop, path, limits):
            return stop
    return None


def _find_fastest(path: BlendedPath, start: float, end: float, limits: Limits) -> list[Section]:
    """Return the sections of the fastest of several motions along a path, from rest to rest.

    `start` and `end` are path parameters in rad. Motions with too many sections for a message are
    not considered.
    """
    first, last = path.find_pieces((start, end - COINCIDENT_RAD))
    bounds = PathBounds(*(bound[first : last + 1] for bound in path.bounds))
    corners = int(bounds.second.any(axis=1).sum())
    candidates = [([start, *path.breaks[first + 1 : last + 1].tolist(), end], bounds)]
    # With many small corners, one set of limits for all pieces may be faster.
    if last > first:
        candidates.append(
            ([start, end], PathBounds(*(bound.max(axis=0, keepdims=True) for bound in bounds)))
        )
    best: list[Section] = []
    least_time_s = np.inf
    for share in SPEED_FRACTIONS if corners else SPEED_FRACTIONS[:1]:
        for marks, pieces in candidates:
            stretches = [
                compute_speed_limits(PathBounds(*piece), limits, share)
                for piece in zip(*pieces, strict=True)
            ]
            sections = list(_build_sections(marks, stretches))
            # `fsum` is exact, whereas `sum` rounds differently from Python 3.12 on.
            time_s = math.fsum(row[0] for row in sections)
            if time_s < least_time_s and len(sections) <= SECTIONS_PER_LINE * (1 + corners):
                best = sections
                least_time_s = time_s
    return best


def _build_sections(marks: Sequence[float], limits: Sequence[SpeedLimits]) -> Iterator[Section]:
    """Yield the sections of a motion from rest at the first mark to rest at the last.

    `marks` are path parameters in rad. Each stretch between two marks has an entry in `limits`.
    """
    lengths = [end - start for start, end in pairwise(marks)]
    speeds = compute_boundary_speeds(lengths, limits)
    for start, length, limit, (before, after) in zip(
        marks, lengths, limits, pairwise(speeds), strict=False
    ):
        if limit.acceleration > 0.0:
            request = _build_ruckig_input(
                PathState(start, before, 0.0), limit.acceleration, limit.jerk
            )
            request.target_position = [start + length]
            request.target_velocity = [after]
            request.max_velocity = [limit.speed]
            yield from _run_ruckig(request)
        else:
            lasts_s = length / before if before > 0.0 else np.inf
            yield (lasts_s, start, before, 0.0, 0.0)


def _build_ruckig_input(
    state: PathState, acceleration: float, jerk: float
) -> ruckig.InputParameter:
    """Return ruckig's input for a motion of s that begins at `state`."""
    request = ruckig.InputParameter(1)
    request.current_position = [state.s]
    request.current_velocity = [state.ds]
    request.current_acceleration = [state.dds]
    request.max_acceleration = [acceleration]
    request.max_jerk = [jerk]
    return request


def _run_ruckig(request: ruckig.InputParameter) -> list[Section]:
    """Run ruckig for a motion of s, and return the sections of the result.

    Raises:
        ArithmeticError: ruckig finds no solution.
    """
    trajectory = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, trajectory)
    if result != ruckig.Result.Working:
        raise ArithmeticError(f"trajectory: ruckig returned {result} for {request}")
    profile = trajectory.profiles[0][0]
    rows = zip(profile.t, profile.p, profile.v, profile.a, profile.j, strict=False)
    return [row for row in rows if row[0] > MIN_SECTION_S]


def _join_sections(rows: Sequence[Section], begin: float) -> Trajectory:
    """Join consecutive sections to a trajectory. Without sections it rests at `begin`."""
    if not rows:
        return Trajectory(np.array([[0.0, begin, 0.0, 0.0, 0.0]]), 0.0)
    sections = np.array(rows)
    ends = np.cumsum(sections[:, 0])
    sections[:, 0] = ends - sections[:, 0]
    return Trajectory(sections, float(ends[-1]))


def _is_within_limits(stop: Trajectory, path: BlendedPath, limits: Limits) -> bool:
    """Return True if every joint stays within its limits during a stop.

    The check uses bounds of motion and path over each interval of time.
    """
    times = _find_check_times(stop)
    s, ds, dds, jerk = stop.evaluate_states(times)
    jerk = np.abs(jerk[:-1])[:, None]
    # In an interval dds is linear and keeps its sign, so values at the ends bound dds and ds.
    acceleration = np.maximum(np.abs(dds[:-1]), np.abs(dds[1:]))[:, None]
    speed = np.maximum(ds[:-1], ds[1:])[:, None]
    first, second, third = _find_bounds_between(path, s)
    # The result of ** 3 on an array differs between processors.
    cubed = speed * speed * speed
    tolerance = 1.0 + LIMIT_ROUNDING
    # The motion must not reverse, which it does if the jerk is too small to end the present
    # deceleration in time.
    return bool(
        (ds > -LIMIT_ROUNDING).all()
        and (first * speed <= limits.velocity * tolerance).all()
        and (second * speed**2 + first * acceleration <= limits.acceleration * tolerance).all()
        and (
            third * cubed + 3.0 * second * speed * acceleration + first * jerk
            <= limits.jerk * tolerance
        ).all()
    )


def _find_check_times(stop: Trajectory) -> Array:
    """Return the ends of the intervals in which a stop is checked, in s from its start.

    They are evenly spaced, with further ends where the jerk or the sign of dds changes.
    """
    start = stop.sections[:, 0]
    dds = stop.sections[:, 3]
    jerk = stop.sections[:, 4]
    until_zero = np.divide(-dds, jerk, out=np.zeros(len(jerk)), where=jerk != 0.0)
    zeros = np.clip(start + until_zero, start, np.append(start[1:], stop.duration))
    return np.unique(
        np.concatenate((start, zeros, np.linspace(0.0, stop.duration, STOP_INTERVALS + 1)))
    )


def _find_bounds_between(path: BlendedPath, s: Array) -> PathBounds:
    """Return bounds of the path's first three derivatives between consecutive values of `s`.

    Each bound is (n - 1, joints).
    """
    piece = path.find_pieces(s)
    low = piece[:-1]
    high = piece[1:]
    bounds = [bound[low] for bound in path.bounds]
    for k in range(1, int((high - low).max()) + 1):
        for total, bound in zip(bounds, path.bounds, strict=True):
            np.maximum(total, bound[np.minimum(low + k, high)], out=total)
    return PathBounds(*bounds)
