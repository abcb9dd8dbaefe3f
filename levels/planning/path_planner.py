"""Collision-free paths between two configurations: straight where that is free, else sampled, with rounded corners."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import norm
from rack.levels.messages import WAYPOINTS
from rack.levels.planning.path import Path
from rack.levels.planning.reach import lever_arms
from rack.levels.planning.sampling import SampledSearch
from rack.levels.primitive.path import BlendedPath
from rack.levels.primitive.trajectory import duration
from rack.levels.robot.cell import Cell

Array = NDArray[np.float64]
Free = Callable[[Array], bool]

CHECKS = 24_000
"""Configurations that may be checked, all searches of a plan together: what bounds its time."""
SEARCHES = 6
"""Searches of one plan, each with a seed of its own; the quickest path found is taken."""
LARGEST_SEED = 2**31 - 1
STEP_PART = 0.5
"""No point of the arm moves farther between two checks than this part of the clearance."""
LEAST_LEVER_M = 0.05
"""Joints that hardly move any geom still count this much in the metric."""
BLENDS = (1.0, 0.6, 0.35, 0.2, 0.1)
"""Parts of the largest blend that are tried at a corner; when all collide, the motion stops there."""
END_PART = 0.9
"""Part of the first and the last line that a blend may take."""


class PathPlanner:
    """Plans paths for one arm. Pure: equal arguments give equal paths."""

    def __init__(self, cell: Cell, clearance: float, seed: int) -> None:
        self._limits = cell.limits
        self._seed = seed
        levers = np.maximum(lever_arms(cell, seed), LEAST_LEVER_M)
        # sum |lever_j dq_j| <= |lever| |dq|: a step of this length, in rad, moves no point by more than intended.
        self.step_rad = STEP_PART * clearance / norm(levers)
        low, high = cell.limits.position.T
        resolution = STEP_PART * clearance / float(np.sqrt(len(levers)))
        self._search = SampledSearch(low, high, levers, resolution)

    def plan(self, start: Array, goal: Array, free: Free, attempt: int = 0, searches: int = SEARCHES) -> Path | None:
        """Return the quickest path found from `start` to `goal` (joints,), rad, or None.

        `attempt` asks for other random numbers: for another try in the same world. With fewer `searches` the path is
        found sooner and is never quicker than with more.
        """
        if not (free(start) and free(goal)):
            return None
        straight = np.array([start, goal])
        if self._line_is_free(start, goal, free):
            return Path(straight, np.zeros(2))
        paths = self._sampled(start, goal, free, attempt, searches)
        return min(paths, key=self.duration, default=None)

    def rounded(self, waypoints: Array, free: Free) -> Path:
        """Return the path along `waypoints` with each corner rounded as far as that is free."""
        blend = _largest_blends(waypoints)
        for corner in range(1, len(waypoints) - 1):
            blend[corner] = self._free_blend(waypoints, corner, float(blend[corner]), free)
        return Path(waypoints, blend)

    def is_free(self, path: Path, free: Free) -> bool:
        """Say whether all of `path` is free."""
        return self.first_blocked(path, free) is None

    def first_blocked(self, path: Path, free: Free) -> Array | None:
        """Return the first configuration on `path` that is not free; None when all are."""
        return next((q for q in BlendedPath(*path).sample(self.step_rad) if not free(q)), None)

    def duration(self, path: Path) -> float:
        """Return the time of `path`, rest to rest, in s."""
        return duration(BlendedPath(*path), self._limits)

    def _sampled(self, start: Array, goal: Array, free: Free, attempt: int, searches: int) -> list[Path]:
        paths: list[Path] = []
        left = CHECKS
        for k in range(SEARCHES):
            seed = 1 + (self._seed + attempt * SEARCHES + k) % LARGEST_SEED
            polyline, checks = self._search.search(start, goal, free, seed, left)
            left -= checks
            if polyline is not None and len(polyline) <= WAYPOINTS:
                paths.append(self.rounded(polyline, free))
            if left <= 0 or len(paths) == searches:
                break
        return paths

    def _line_is_free(self, one: Array, other: Array, free: Free) -> bool:
        count = int(np.ceil(norm(other - one) / self.step_rad)) + 1
        return all(free(q) for q in np.linspace(one, other, max(count, 2)))

    def _free_blend(self, waypoints: Array, corner: int, largest: float, free: Free) -> float:
        before, at, behind = waypoints[corner - 1 : corner + 2]
        for part in BLENDS:
            b = part * largest
            ends = [at + b * (end - at) / max(norm(end - at), b) for end in (before, behind)]
            if self.is_free(Path(np.array([ends[0], at, ends[1]]), np.array([0.0, b, 0.0])), free):
                return b
        return 0.0


def _largest_blends(waypoints: Array) -> Array:
    """Return blends (k,) that do not overlap: up to half of an inner line, most of the first and the last."""
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    room = 0.5 * lengths
    room[[0, -1]] = END_PART * lengths[[0, -1]] if len(lengths) > 1 else 0.0
    blend = np.zeros(len(waypoints))
    blend[1:-1] = np.minimum(room[:-1], room[1:])
    return blend
