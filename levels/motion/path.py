"""A path in joint space: straight lines with rounded corners."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rack.levels.algebra import Array, norm
from rack.levels.compiled import compiled_for

COINCIDENT_RAD = 1e-7
"""Waypoints closer than this count as one, and a shorter blend counts as none."""
MAX_STRAIGHT_BEND = 1e-9
"""Two unit directions that differ by less than this count as equal: the corner between them needs
no stop."""
OVERLAP_ROUNDING = 1e-9
"""Blends may overlap by this part of the line between them, from rounding."""


class Path(NamedTuple):
    """A path in the form that messages carry: waypoints and blends."""

    waypoints: Array  # (k, joints), rad
    blend: Array  # (k,), rad: each corner is rounded over this length on both sides

    @property
    def end(self) -> Array:
        """The last waypoint (joints,), rad."""
        return np.asarray(self.waypoints[-1])


class PathPoint(NamedTuple):
    """One point of a path and the derivatives by its parameter s there."""

    q: Array  # (joints,), rad
    dq_ds: Array  # (joints,), 1
    d2q_ds2: Array  # (joints,), 1/rad


class PathBounds(NamedTuple):
    """Largest magnitudes of the path's derivatives by s on each of its pieces."""

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
        """Build the path of `waypoints` (k, joints) in rad with `blend` (k,) in rad.

        Raises `ValueError` for shapes that do not match, values that are not finite, a negative
        blend, and blends of neighbours that overlap.
        """
        points, radii = _distinct(*_checked(waypoints, blend))
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        _check_overlap(radii, lengths)
        self.waypoints = points  # (k, joints), rad, without coincident ones
        self.blend = radii  # (k,), rad
        self.joints = points.shape[1]
        self._directions = steps / lengths[:, None]
        self._corners = np.concatenate(([0.0], np.cumsum(lengths)))
        self.length = float(self._corners[-1])  # rad
        self._lay_pieces()
        self._marks, self._table = self._tabulate()
        self._point = np.zeros((3, self.joints))

    def evaluate(self, s: float) -> PathPoint:
        """Return the point at `s`, clamped to the path. The next call overwrites its arrays."""
        set_point.load()(self._marks, self._table, min(max(s, 0.0), self.length), self._point)
        # Not kept: in a path that comes from a checkpoint they would be copies.
        return PathPoint(*self._point)

    def piece_at(self, s: float) -> int:
        """Return the index of the piece that contains `s`; at a break, of the piece that begins
        there."""
        return min(max(bisect_right(self._breaks, s) - 1, 0), len(self._pieces) - 1)

    def sample(self, step_rad: float) -> Array:
        """Return points along the path, both ends included, at most `step_rad` of s apart; (n,
        joints)."""
        count = max(int(np.ceil(self.length / step_rad)), 1) + 1 if self.length > 0.0 else 1
        return points_at.load()(self._marks, self._table, np.linspace(0.0, self.length, count))

    def _lay_pieces(self) -> None:
        """Cut the path into lines (line, -1) and corners (line before, corner)."""
        last = len(self.waypoints) - 1
        self._starts: list[float] = self._corners.tolist()
        self._radii: list[float] = self.blend.tolist()
        self._changes = np.zeros_like(self.waypoints)
        self._changes[1:last] = np.diff(self._directions, axis=0)
        self.stops: list[float] = []  # s of the corners where motion must come to rest, rad
        self._pieces: list[tuple[int, int]] = []
        self._breaks: list[float] = [0.0]
        for line in range(last):
            corner = line + 1
            b = self._radii[line + 1]
            self._add_piece((line, -1), self._starts[corner] - b)
            if b > 0.0:
                self._add_piece((line, corner), self._starts[corner] + b)
            elif corner < last and norm(self._changes[corner]) > MAX_STRAIGHT_BEND:
                self.stops.append(self._starts[corner])
        if not self._pieces:
            self._pieces = [(-1, -1)]
            self._breaks = [0.0, self.length]
        self.breaks = np.array(
            self._breaks
        )  # (pieces + 1,), rad: s where each piece begins, and the end

    def _add_piece(self, piece: tuple[int, int], end: float) -> None:
        """Append a piece up to `end`, unless adjacent blends leave no line between them."""
        if end - self._breaks[-1] > COINCIDENT_RAD:
            self._pieces.append(piece)
            self._breaks.append(end)

    def _tabulate(self) -> tuple[Array, Array]:
        """Return the pieces in the rows of `set_point`."""
        marks = np.zeros((len(self._pieces), 3))
        table = np.zeros((len(self._pieces), 3, self.joints))
        for k, (line, corner) in enumerate(self._pieces):
            at = max(line if corner < 0 else corner, 0)
            marks[k] = self._breaks[k], self._starts[at], self._radii[at] if corner >= 0 else 0.0
            table[k, 0] = self.waypoints[at]
            if line >= 0:
                table[k, 1] = self._directions[line]
            if corner >= 0:
                table[k, 2] = self._changes[corner]
        return marks, table

    @cached_property
    def bounds(self) -> PathBounds:
        """Bounds of every piece; many a path is only sampled."""
        first, second, third = (np.zeros((len(self._pieces), self.joints)) for _ in range(3))
        for k, (line, corner) in enumerate(self._pieces):
            if corner >= 0:
                b = self._radii[corner]
                change = np.abs(self._changes[corner])
                first[k] = np.abs(self._directions[corner - 1 : corner + 1]).max(axis=0)
                second[k] = 0.75 * change / b
                third[k] = 1.5 * change / b**2
            elif line >= 0:
                first[k] = np.abs(self._directions[line])
        return PathBounds(first, second, third)


@compiled_for("f8[:,::1], f8[:,:,::1], f8, f8[:,::1]")
def set_point(
    marks: Array,  # (pieces, 3), rad: s where it begins, s of its waypoint, its blend; 0: a line
    table: Array,  # (pieces, 3, joints): the waypoint, rad, the direction there, its change
    s: float,  # rad
    point: Array,  # (3, joints): set, in the rows of `PathPoint`
) -> None:
    """Set the point of a path at `s`: q = P + u1 sigma + (u2 - u1) h, and its derivatives."""
    piece = len(marks) - 1
    while piece > 0 and s < marks[piece, 0]:
        piece -= 1
    waypoint = table[piece, 0]
    direction = table[piece, 1]
    change = table[piece, 2]
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
def points_at(marks: Array, table: Array, places: Array) -> Array:
    """Return the points of a path at `places` (n,), rad: (n, joints), rad."""
    points = np.empty((len(places), table.shape[2]))
    point = np.empty((3, table.shape[2]))
    for k in range(len(places)):
        set_point(marks, table, places[k], point)
        points[k] = point[0]
    return points


def _checked(waypoints: ArrayLike, blend: ArrayLike) -> tuple[Array, Array]:
    points = np.array(waypoints, dtype=float)
    radii = np.array(blend, dtype=float)
    if points.ndim != 2 or len(points) == 0:
        raise ValueError(f"path: waypoints of shape {points.shape}; valid: (k, joints) with k >= 1")
    if radii.shape != (len(points),):
        raise ValueError(
            f"path: blend of shape {radii.shape}; valid: {(len(points),)}, one per waypoint"
        )
    if not (np.isfinite(points).all() and np.isfinite(radii).all()):
        raise ValueError("path: a waypoint or a blend is not finite")
    if (radii < 0.0).any():
        raise ValueError(
            f"path: blend {radii.min():.4g} rad of corner {radii.argmin()}; valid: 0 or more"
        )
    return points, radii


def _distinct(points: Array, radii: Array) -> tuple[Array, Array]:
    """Merge coincident waypoints; clear the blends of the two ends."""
    kept = [0]
    merged = radii.copy()
    for k in range(1, len(points)):
        if norm(points[k] - points[kept[-1]]) > COINCIDENT_RAD:
            kept.append(k)
        else:
            merged[kept[-1]] = min(merged[kept[-1]], radii[k])
    merged[merged < COINCIDENT_RAD] = 0.0
    merged[kept[0]] = merged[kept[-1]] = 0.0
    return points[kept], merged[kept]


def _check_overlap(radii: Array, lengths: Array) -> None:
    for k, length in enumerate(lengths):
        if radii[k] + radii[k + 1] > length * (1.0 + OVERLAP_ROUNDING) + COINCIDENT_RAD:
            raise ValueError(
                f"path: blends {radii[k]:.4g} and {radii[k + 1]:.4g} rad of corners {k} and {k + 1}"
                f" overlap; valid: together at most the line between them, {length:.4g} rad"
            )
