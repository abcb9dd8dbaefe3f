"""A path in joint space: straight lines with rounded corners."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rack.levels.algebra import Array, Ints, norm
from rack.levels.compiled import compiled_for

COINCIDENT_RAD = 1e-7
"""Waypoints closer than this count as one, and shorter blends count as 0."""
MAX_STRAIGHT_BEND = 1e-9
"""Difference of two unit directions below which they count as equal.

A corner between such directions needs no stop.
"""
OVERLAP_ROUNDING = 1e-9
"""Fraction of a line by which its blends may overlap, to allow for rounding."""


class Path(NamedTuple):
    """A path in the form that messages contain: waypoints and blends."""

    waypoints: Array  # (k, joints), rad
    blend: Array  # (k,), rad: length over which a corner is rounded, on each side

    @property
    def end(self) -> Array:
        """Last waypoint, (joints,), in rad."""
        return np.asarray(self.waypoints[-1])


class PathPoint(NamedTuple):
    """A point of a path and its derivatives by the path parameter s."""

    q: Array  # (joints,), rad
    dq_ds: Array  # (joints,), 1
    d2q_ds2: Array  # (joints,), 1/rad


class PathBounds(NamedTuple):
    """Largest magnitudes of the derivatives by s on each piece of a path."""

    first: Array  # (pieces, joints), 1
    second: Array  # (pieces, joints), 1/rad
    third: Array  # (pieces, joints), 1/rad2


class BlendedPath:
    """A polyline whose corner k is rounded over +-blend[k], in rad along the lines.

    The path parameter s, 0 to `length` in rad, is the arc length along the polyline. With the unit
    directions u1 before and u2 after the corner P and sigma = s - s_corner in [-b, b],

        q = P + u1 (sigma - h(sigma)) + u2 h(sigma),   h' = 3 t^2 - 2 t^3,   t = (sigma + b) / 2b,

    so that q'' is continuous and zero at both ends, |q'_j| <= max(|u1_j|, |u2_j|),
    |q''_j| <= 0.75 |u2_j - u1_j| / b and |q'''_j| <= 1.5 |u2_j - u1_j| / b^2.

    A corner with blend 0 is a stop. The blends of the first and the last waypoint are ignored.
    Coincident waypoints count once, with the smaller blend.
    """

    def __init__(self, waypoints: ArrayLike, blend: ArrayLike) -> None:
        """Build a path.

        Args:
            waypoints: (k, joints), rad.
            blend: Length over which each corner is rounded, on each side, (k,), rad.

        Raises:
            ValueError: Shapes do not match, values are not finite, or blends are negative or
                overlap.
        """
        points, radii = _merge_coincident(*_check_arrays(waypoints, blend))
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        for k, length in enumerate(lengths):
            if radii[k] + radii[k + 1] > length * (1.0 + OVERLAP_ROUNDING) + COINCIDENT_RAD:
                raise ValueError(
                    f"path: blends {radii[k]:.4g} and {radii[k + 1]:.4g} rad of corners {k} and"
                    f" {k + 1} overlap; the line between them is only {length:.4g} rad long"
                )
        self.waypoints = points  # (k, joints), rad, without coincident ones
        self.blend = radii  # (k,), rad
        self.joints = points.shape[1]
        # Unit directions from each waypoint to the next, and their change at each corner.
        directions = np.vstack((steps / lengths[:, None], np.zeros_like(points[:1])))
        self._changes = np.zeros_like(points)
        self._changes[1:-1] = np.diff(directions[:-1], axis=0)
        self._corners = np.concatenate(([0.0], np.cumsum(lengths)))
        self.length = float(self._corners[-1])  # rad
        self.stops: list[float] = []  # s of the corners where motion must come to rest, rad
        pieces, breaks = self._divide_into_pieces()
        self.breaks = np.array(breaks)  # (pieces + 1,), rad: s where each piece begins, and the end
        at, radius = (np.array(column) for column in zip(*pieces, strict=True))
        before = at - (radius > 0.0)
        blends = radius[:, None]
        changes = np.where(blends > 0.0, self._changes[at], 0.0)
        # For the layout of the two tables see `compute_point`.
        self._marks = np.hstack((self.breaks[:-1, None], self._corners[at, None], blends))
        self._table = np.stack((points[at], directions[before], changes), axis=1)
        self._point = np.zeros((3, self.joints))
        changes = np.abs(changes)
        widths = np.where(blends > 0.0, blends, np.inf)
        self.bounds = PathBounds(
            np.maximum(np.abs(directions[before]), np.abs(directions[at])),
            0.75 * changes / widths,
            1.5 * changes / widths**2,
        )

    def evaluate(self, s: float) -> PathPoint:
        """Return the point at `s`, which is clamped to the path.

        The next call overwrites the arrays of the point.
        """
        compute_point.load_machine_code()(
            self._marks, self._table, min(max(s, 0.0), self.length), self._point
        )
        return PathPoint(*self._point)

    def find_pieces(self, s: ArrayLike) -> Ints:
        """Return the index of the piece that contains each of the path parameters `s`, in rad.

        A boundary between two pieces belongs to the second one.
        """
        pieces = np.searchsorted(self.breaks, s, side="right") - 1
        return np.clip(pieces, 0, len(self.breaks) - 2)

    def sample_points(self, step_rad: float) -> Array:
        """Return points along the path, including both ends, (n, joints), in rad.

        Consecutive points differ by at most `step_rad` in s.
        """
        count = max(int(np.ceil(self.length / step_rad)), 1) + 1 if self.length > 0.0 else 1
        return compute_points.load_machine_code()(
            self._marks, self._table, np.linspace(0.0, self.length, count)
        )

    def _divide_into_pieces(self) -> tuple[list[tuple[int, float]], list[float]]:
        """Divide the path into lines and corners, and add its stops to `stops`.

        Returns:
            The pieces, and the values of s at their ends, in rad. A corner is given as the index of
            its waypoint and its blend, a line as the index of its first waypoint and 0.
        """
        last = len(self.waypoints) - 1
        starts: list[float] = self._corners.tolist()
        pieces: list[tuple[int, float]] = []
        breaks = [0.0]
        for corner, b in enumerate(self.blend.tolist()[1:], start=1):
            start = starts[corner]
            # Between adjacent blends there is no line.
            for piece, end in (((corner - 1, 0.0), start - b), ((corner, b), start + b)):
                if end - breaks[-1] > COINCIDENT_RAD:
                    pieces.append(piece)
                    breaks.append(end)
            if b == 0.0 and corner < last and norm(self._changes[corner]) > MAX_STRAIGHT_BEND:
                self.stops.append(start)
        return (pieces, breaks) if pieces else ([(0, 0.0)], [0.0, self.length])


@compiled_for("f8[:,::1], f8[:,:,::1], f8, f8[:,::1]")
def compute_point(
    marks: Array,
    table: Array,
    s: float,
    point: Array,
) -> None:
    """Compute the point of a path at `s`: q = P + u1 sigma + (u2 - u1) h, and its derivatives.

    Args:
        marks: (pieces, 3), rad: s at the start of each piece, s of its waypoint, its blend (0 for a
            line).
        table: (pieces, 3, joints): the waypoint, rad, the unit direction before it, and the change
            of direction there.
        s: Path parameter, rad.
        point: Receives the result, (3, joints), in the row order of `PathPoint`.
    """
    piece = len(marks) - 1
    while piece > 0 and s < marks[piece, 0]:
        piece -= 1
    waypoint, direction, change = table[piece]
    b = marks[piece, 2]
    sigma = s - marks[piece, 1]
    for j in range(len(waypoint)):
        point[0, j] = direction[j] * sigma + waypoint[j]
        point[1, j] = direction[j]
        point[2, j] = 0.0
    if b > 0.0:
        t = (sigma + b) / (2.0 * b)
        h = 2.0 * b * math.pow(t, 3.0) * (1.0 - 0.5 * t)
        rate = t * t * (3.0 - 2.0 * t)
        second = 3.0 * t * (1.0 - t) / b
        for j in range(len(waypoint)):
            point[0, j] += change[j] * h
            point[1, j] += change[j] * rate
            point[2, j] = change[j] * second


@compiled_for("f8[:,::1], f8[:,:,::1], f8[::1]")
def compute_points(marks: Array, table: Array, places: Array) -> Array:
    """Return points of a path, (n, joints), in rad.

    Args:
        marks: See `compute_point`.
        table: See `compute_point`.
        places: Path parameters, (n,), rad.
    """
    points = np.empty((len(places), table.shape[2]))
    point = np.empty((3, table.shape[2]))
    for k in range(len(places)):
        compute_point(marks, table, places[k], point)
        points[k] = point[0]
    return points


def _check_arrays(waypoints: ArrayLike, blend: ArrayLike) -> tuple[Array, Array]:
    """Return waypoints and blends as arrays. Raises `ValueError` for invalid shapes or values."""
    points = np.array(waypoints, dtype=float)
    radii = np.array(blend, dtype=float)
    if points.ndim != 2 or len(points) == 0:
        raise ValueError(f"path: waypoints have shape {points.shape}, must be (k, joints), k >= 1")
    if radii.shape != (len(points),):
        raise ValueError(
            f"path: blend has shape {radii.shape}, must be {(len(points),)}, one per waypoint"
        )
    if not (np.isfinite(points).all() and np.isfinite(radii).all()):
        raise ValueError("path: a waypoint or a blend is not finite")
    if (radii < 0.0).any():
        raise ValueError(
            f"path: blend of corner {radii.argmin()} is {radii.min():.4g} rad, must be 0 or more"
        )
    return points, radii


def _merge_coincident(points: Array, radii: Array) -> tuple[Array, Array]:
    """Return waypoints and blends without coincident waypoints. The blends of both ends are 0."""
    distinct = [0]
    merged = radii.copy()
    for k in range(1, len(points)):
        if norm(points[k] - points[distinct[-1]]) > COINCIDENT_RAD:
            distinct.append(k)
        else:
            merged[distinct[-1]] = min(merged[distinct[-1]], radii[k])
    merged[merged < COINCIDENT_RAD] = 0.0
    merged[distinct[0]] = merged[distinct[-1]] = 0.0
    return points[distinct], merged[distinct]
