"""Straight motion of the tool: a joint path that follows a line on one branch of the inverse kinematics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import mat_vec, norm
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.path import Path
from rack.levels.planning.pose import Pose
from rack.levels.primitive.path import BlendedPath

Array = NDArray[np.float64]

STRAY_M = 1e-3
"""How far the tool may stray from the line."""
LINES = (1, 2, 3, 4, 6, 8, 12, 16, 20)
"""Numbers of joint-space lines that are tried: the fewest that stay on the tool's line make the quickest path."""
STRAY_SAMPLES = 5
"""Points of every joint-space line at which the tool's distance from its line is measured."""


def straight_line(ik: InverseKinematics, start: Array, target: Pose) -> Path | None:
    """Return a path along which the tool goes straight from where `start` (joints,) puts it to `target`.

    The tool turns at a constant rate and strays at most `STRAY_M`. None when the line leaves the reach of the arm,
    or goes on only on another branch. Collisions are not looked at.
    """
    begin = ik.tool_at(start)
    for lines in LINES:
        points = _points_on(ik, begin, target, start, lines)
        if points is not None:
            path = _smooth(points)
            if _stray(ik, path, begin, target) < STRAY_M:
                return path
    return None


def _points_on(ik: InverseKinematics, begin: Pose, target: Pose, start: Array, lines: int) -> Array | None:
    points = [start]
    for k in range(1, lines + 1):
        q = ik.nearby(begin.towards(target, k / lines), points[-1])
        if q is None:
            return None
        points.append(q)
    return np.array(points)


def _smooth(points: Array) -> Path:
    """Round every corner by half of the shorter line beside it: neighbours meet, nothing stops."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    blend = np.zeros(len(points))
    blend[1:-1] = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    return Path(points, blend)


def _stray(ik: InverseKinematics, path: Path, begin: Pose, target: Pose) -> float:
    """Return the largest distance of the tool from the straight line, in m."""
    blended = BlendedPath(*path)
    if blended.length == 0.0:
        return 0.0
    way = target.position - begin.position
    length = norm(way)
    samples = blended.sample(blended.length / (STRAY_SAMPLES * (len(path.waypoints) - 1)))
    off = np.array([ik.tool_at(q).position - begin.position for q in samples])
    if length > 0.0:
        off -= np.outer(mat_vec(off, way) / length**2, way)
    return float(np.max(np.linalg.norm(off, axis=1)))
