"""Time along a path: sections of constant jerk of its parameter, within the limits of every joint."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import ruckig
from numpy.typing import NDArray

from rack.levels.messages import SECTIONS_A_LINE
from rack.levels.primitive.path import COINCIDENT_RAD, BlendedPath, PathBounds
from rack.levels.primitive.speed import JointLimits, SpeedLimits, boundary_speeds, speed_limits

Array = NDArray[np.float64]

SHARES = (1.0, 0.9, 0.75, 0.6)
"""Parts of a curve's highest speed that are tried; the fastest trajectory is taken."""
SHORTEST_S = 1e-12
"""Sections shorter than this are dropped."""

Section = tuple[float, float, float, float, float]
"""Duration, then s, ds, dds at its begin and its constant jerk."""


class Motion(NamedTuple):
    """State of the path parameter: rad, rad/s, rad/s2."""

    s: float
    ds: float
    dds: float


class Trajectory:
    """Motion along a path as sections of constant jerk.

    `sections` (n, 5), n >= 1: start in s, then s, ds, dds and jerk of the path parameter there; the last one ends at
    `duration`, in s, at rest. `begin` and `end` are the path parameter at both ends, in rad.
    """

    def __init__(self, sections: Array, duration: float) -> None:
        self.sections = sections
        self.duration = duration
        self._starts: list[float] = sections[:, 0].tolist()
        self._rows: list[list[float]] = sections[:, 1:].tolist()
        self.begin = self._rows[0][0]
        self.end = self.at(duration).s

    def at(self, time_s: float) -> Motion:
        """Return the motion `time_s` behind the start."""
        time_s = min(max(time_s, 0.0), self.duration)
        k = max(bisect_right(self._starts, time_s) - 1, 0)
        s, ds, dds, jerk = self._rows[k]
        t = time_s - self._starts[k]
        return Motion(s + t * (ds + t * (dds / 2.0 + t * jerk / 6.0)), ds + t * (dds + t * jerk / 2.0), dds + t * jerk)

    def states(self, times_s: Array) -> tuple[Array, Array, Array]:
        """Return s, ds and dds at `times_s` (n,), within the duration; (n,) each."""
        row = self.sections[np.searchsorted(self.sections[:, 0], times_s, side="right") - 1]
        t = times_s - row[:, 0]
        s, ds, dds, jerk = row[:, 1], row[:, 2], row[:, 3], row[:, 4]
        return s + t * (ds + t * (dds / 2.0 + t * jerk / 6.0)), ds + t * (dds + t * jerk / 2.0), dds + t * jerk

    def stretched(self, factor: float) -> Trajectory:
        """Return the same motion `factor` >= 1 times as slow; it keeps every limit that this one keeps."""
        powers = np.array([factor, 1.0, 1.0 / factor, 1.0 / factor**2, 1.0 / factor**3])
        return Trajectory(self.sections * powers, self.duration * factor)


def make_trajectory(path: BlendedPath, limits: JointLimits, begin: float = 0.0) -> Trajectory:
    """Make the fastest motion found from rest at `begin`, in rad, to rest at the end of `path`.

    It rests at the path's stops too. Joint velocity, acceleration and jerk keep `limits` everywhere: by
    the path's analytic bounds, not by sampling. At most `SECTIONS` sections.
    """
    stops = [s for s in path.stops if s > begin + COINCIDENT_RAD]
    marks = [min(begin, path.length), *stops, path.length]
    rows: list[Section] = []
    for start, end in pairwise(marks):
        if end - start > COINCIDENT_RAD:
            rows += _fastest(_Run(path, start, end), limits)
    return joined(rows, marks[0])


def duration(path: BlendedPath, limits: JointLimits) -> float:
    """Return the time of the fastest motion found along `path`, rest to rest, in s."""
    return make_trajectory(path, limits).duration


class _Run:
    """A stretch of a path between two points of rest, and the bounds of its pieces."""

    def __init__(self, path: BlendedPath, start: float, end: float) -> None:
        first, last = path.piece_at(start), path.piece_at(end - COINCIDENT_RAD)
        inner = path.breaks[first + 1 : last + 1]
        self.marks = [start, *inner.tolist(), end]
        self.bounds = PathBounds(*(bound[first : last + 1] for bound in path.bounds))
        corners = int(self.bounds.second.any(axis=1).sum())
        self.shares = SHARES if corners else SHARES[:1]
        self.most_sections = SECTIONS_A_LINE * (1 + corners)

    def ways(self) -> list[tuple[list[float], PathBounds]]:
        """Return marks and bounds: each piece with limits of its own, or one set for all: for many small corners."""
        alone = (self.marks, self.bounds)
        together = PathBounds(*(bound.max(axis=0, keepdims=True) for bound in self.bounds))
        return [alone, ([self.marks[0], self.marks[-1]], together)] if len(self.marks) > 2 else [alone]


def _fastest(run: _Run, limits: JointLimits) -> list[Section]:
    """Return the fastest of a few candidates that has no more sections than a message has room for."""
    best: list[Section] = []
    least = np.inf
    for share in run.shares:
        for marks, bounds in run.ways():
            stretches = [speed_limits(*each, limits, share) for each in zip(*bounds, strict=True)]
            rows = list(_sections(marks, stretches))
            time_s = math.fsum(row[0] for row in rows)  # exact: `sum` rounds otherwise from Python 3.12 on
            if time_s < least and len(rows) <= run.most_sections:
                best, least = rows, time_s
    return best


def _sections(marks: Sequence[float], limits: Sequence[SpeedLimits]) -> Iterator[Section]:
    """Yield the sections from rest at the first to rest at the last mark, each stretch with its limits."""
    lengths = [end - start for start, end in pairwise(marks)]
    speeds = boundary_speeds(lengths, limits)
    for start, length, limit, (before, behind) in zip(marks, lengths, limits, pairwise(speeds), strict=False):
        if limit.acceleration > 0.0:
            yield from _stretch(start, start + length, before, behind, limit)
        else:
            yield (length / before if before > 0.0 else np.inf, start, before, 0.0, 0.0)


def _stretch(start: float, end: float, before: float, behind: float, limit: SpeedLimits) -> list[Section]:
    """Return the fastest way from `start` at speed `before` to `end` at speed `behind`."""
    wanted = ruckig.InputParameter(1)
    wanted.current_position, wanted.current_velocity = [start], [before]
    wanted.target_position, wanted.target_velocity = [end], [behind]
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [limit.speed], [limit.acceleration], [limit.jerk]
    return calculated(wanted)


def calculated(wanted: ruckig.InputParameter) -> list[Section]:
    """Return the sections of ruckig's answer in one dimension. Raises `ArithmeticError` when it has none."""
    found = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(wanted, found)
    if result != ruckig.Result.Working:
        raise ArithmeticError(f"trajectory: ruckig answers {result} to {wanted}")
    profile = found.profiles[0][0]
    rows = zip(profile.t, profile.p, profile.v, profile.a, profile.j, strict=False)
    return [row for row in rows if row[0] > SHORTEST_S]


def joined(rows: Sequence[Section], begin: float) -> Trajectory:
    """Return the trajectory of consecutive sections."""
    if not rows:
        return Trajectory(np.array([[0.0, begin, 0.0, 0.0, 0.0]]), 0.0)
    sections = np.array(rows)
    ends = np.cumsum(sections[:, 0])
    sections[:, 0] = ends - sections[:, 0]
    return Trajectory(sections, float(ends[-1]))
