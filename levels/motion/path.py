"""A path in joint space: straight lines with rounded corners."""

from __future__ import annotations

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rack.levels.algebra import Array, norm

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
        self.bounds = self._bound_pieces()
        self._point = PathPoint(np.zeros(self.joints), np.zeros(self.joints), np.zeros(self.joints))
        self._scratch = np.zeros(self.joints)

    def evaluate(self, s: float) -> PathPoint:
        """Return the point at `s`, clamped to the path. The next call overwrites its arrays."""
        s = min(max(s, 0.0), self.length)
        line, corner = self._pieces[self.piece_at(s)]
        q, dq, d2q = self._point
        d2q.fill(0.0)
        if corner < 0:
            if line < 0:
                q[:] = self.waypoints[0]
                dq.fill(0.0)
                return self._point
            dq[:] = self._directions[line]
            np.multiply(dq, s - self._starts[line], out=q)
            q += self.waypoints[line]
            return self._point
        b = self._radii[corner]
        t = (s - self._starts[corner] + b) / (2.0 * b)
        h = 2.0 * b * t**3 * (1.0 - 0.5 * t)
        # q = P + u1 sigma + (u2 - u1) h, and its derivatives.
        before = self._directions[corner - 1]
        change = self._changes[corner]
        np.multiply(before, s - self._starts[corner], out=q)
        q += self.waypoints[corner]
        q += np.multiply(change, h, out=self._scratch)
        np.multiply(change, t * t * (3.0 - 2.0 * t), out=dq)
        dq += before
        np.multiply(change, 3.0 * t * (1.0 - t) / b, out=d2q)
        return self._point

    def piece_at(self, s: float) -> int:
        """Return the index of the piece that contains `s`; at a break, of the piece that begins
        there."""
        return min(max(bisect_right(self._breaks, s) - 1, 0), len(self._pieces) - 1)

    def sample(self, step_rad: float) -> Array:
        """Return points along the path, both ends included, at most `step_rad` of s apart; (n,
        joints)."""
        count = max(int(np.ceil(self.length / step_rad)), 1) + 1 if self.length > 0.0 else 1
        return np.array([self.evaluate(s).q.copy() for s in np.linspace(0.0, self.length, count)])

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

    def _bound_pieces(self) -> PathBounds:
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
