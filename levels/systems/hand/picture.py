"""A picture of a hand in SVG, as plain text: its fingers, the objects, the forces, seen from the
front and from above.

Everything is in the world's frame: x to the right; z up in the view from the front, y up in that
from above.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from xml.sax.saxutils import escape

import mujoco
import numpy as np

from rack.levels.algebra import Array, mat_vec
from rack.levels.robot.cell import Cell

VIEWS = (("from the front", 0, 2), ("from above", 0, 1))
"""Title, axis to the right, axis up."""
SIDE = 420
GAP = 16
LINE = 17
"""Pixels: sides of a view, between views, from line to line of text."""
REACH_M = 0.16
"""Half of a view's side."""
NEWTONS_A_VIEW = 40.0
"""Force whose arrow is as long as half of a view's side."""
LEAST_N = 0.05
"""Forces below it are not drawn."""
RIM = 24
"""Points on the rim of a round geom."""
HAND = "#4a4f5a"
OBJECT = "#5588cc"
REST = "#c9ccd2"
FORCE = "#cc3311"
PLAN = "#118833"


@dataclass(frozen=True)
class HandScene:
    """What a picture shows: a hand's joints, bodies of the scene, forces on tips, and where they
    should touch."""

    position: Array  # (joints,), rad
    bodies: Array  # (bodies, 3), m, in the order of `scene.bodies`
    quaternions: Array  # (bodies, 4)
    force: Array  # (fingers, 3), N, of the tips on the surroundings, in the palm's frame
    contact: Array  # (n, 3), m, of a plan, in the frame of the object `held`; n is 0 without a plan
    held: int  # row of that object


class HandPicture:
    """Draws one hand; `cell` must have one."""

    def __init__(self, cell: Cell) -> None:
        assert cell.hand is not None, "a cell with a hand"
        self._cell = cell
        self._hand = cell.hand
        self._data = cell.start()
        model = cell.model
        shown = self._data.site_xpos[[cell.tool, *self._hand.tips]]
        self._centre = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
        body = model.geom_bodyid
        objects = np.isin(body, cell.bodies)
        fixed = ~objects & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        hand = np.isin(np.arange(model.ngeom), cell.gripper_geoms)
        palm = hand & (body == model.site_bodyid[cell.tool])
        # Of the geoms, in the order in which they are drawn.
        self._colours = {
            int(geom): colour
            for geoms, colour in ((fixed & ~hand, REST), (fixed & palm, REST), (objects, OBJECT))
            for geom in np.flatnonzero(geoms)
        }
        self._local = {geom: local_points(model, geom) for geom in self._colours}
        joints = model.dof_jntid[cell.dof]
        self._chains = [joints[row] for row in self._hand.fingers]

    def draw(self, scene: HandScene, text: Sequence[str] = ()) -> str:
        """Return the picture, with lines of text to its right."""
        self._pose(scene)
        width = len(VIEWS) * (SIDE + GAP) + SIDE
        height = SIDE + 2 * GAP
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}"'
            ' font-family="sans-serif">'
        ]
        parts.append(f'<rect width="{width}" height="{height}" fill="white"/>')
        for number, (name, right, up) in enumerate(VIEWS):
            parts.append(
                f'<svg x="{GAP + number * (SIDE + GAP)}" y="{GAP}" width="{SIDE}" height="{SIDE}">'
            )
            parts.append(f'<rect width="{SIDE}" height="{SIDE}" fill="#f6f7f9" stroke="{REST}"/>')
            parts += self._view(scene, (right, up))
            parts += [f'<text x="8" y="18" font-size="13" fill="{HAND}">{name}</text>', "</svg>"]
        left = GAP + len(VIEWS) * (SIDE + GAP)
        for row, line in enumerate(text):
            parts.append(
                f'<text x="{left}" y="{GAP + LINE * (row + 1)}"'
                f' font-size="13">{escape(line)}</text>'
            )
        return "\n".join([*parts, "</svg>", ""])

    def _pose(self, scene: HandScene) -> None:
        model = self._cell.model
        data = self._data
        data.qpos[self._cell.qpos] = scene.position
        for row, address in enumerate(self._cell.object_qpos):
            data.qpos[address : address + 7] = *scene.bodies[row], *scene.quaternions[row]
        mujoco.mj_kinematics(model, data)

    def _view(self, scene: HandScene, axes: tuple[int, int]) -> Iterator[str]:
        """Yield the elements of one view, the farthest first."""
        for geom, colour in self._colours.items():
            outline = hull([self._pixel(point, axes) for point in self._surface(geom)])
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in outline)
            yield (
                f'<polygon points="{points}" fill="{colour}" fill-opacity="0.45"'
                f' stroke="{colour}"/>'
            )
        for finger, chain in enumerate(self._chains):
            tip = self._data.site_xpos[self._hand.tips[finger]]
            row = [self._pixel(point, axes) for point in (*self._data.xanchor[chain], tip)]
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in row)
            yield (
                f'<polyline points="{points}" fill="none" stroke="{HAND}" stroke-width="7"'
                ' stroke-linejoin="round"/>'
            )
            yield from (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="white"/>' for x, y in row[:-1]
            )
            x, y = row[-1]
            yield (
                f'<text x="{x + 9:.1f}" y="{y - 9:.1f}"'
                f' font-size="11">{escape(self._hand.names[finger])}</text>'
            )
            yield from self._arrow(row[-1], scene.force[finger], axes)
        body = self._cell.bodies[scene.held]
        turned = self._data.xmat[body].reshape(3, 3)
        for contact in scene.contact:
            x, y = self._pixel(self._data.xpos[body] + mat_vec(turned, contact), axes)
            yield (
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="none" stroke="{PLAN}"'
                ' stroke-width="2"/>'
            )

    def _arrow(
        self, start: tuple[float, float], force: Array, axes: tuple[int, int]
    ) -> Iterator[str]:
        """Yield the force of a tip on what it touches."""
        turned = mat_vec(self._data.site_xmat[self._cell.tool].reshape(3, 3), force)
        scale = SIDE / 2.0 / NEWTONS_A_VIEW
        way = np.array([scale * turned[axes[0]], -scale * turned[axes[1]]])
        length = float(np.sqrt((way**2).sum()))
        if length < LEAST_N * scale:
            return
        x, y = start
        u, v = way / length
        end_x = x + way[0]
        end_y = y + way[1]
        head = min(9.0, length)
        corners = ((0.0, 0.0), (-head, 0.45 * head), (-head, -0.45 * head))
        points = " ".join(
            f"{end_x + a * u - b * v:.1f},{end_y + a * v + b * u:.1f}" for a, b in corners
        )
        yield (
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{end_x:.1f}" y2="{end_y:.1f}" stroke="{FORCE}"'
            ' stroke-width="2"/>'
        )
        yield f'<polygon points="{points}" fill="{FORCE}"/>'

    def _pixel(self, point: Array, axes: tuple[int, int]) -> tuple[float, float]:
        right, up = (float(point[axis] - self._centre[axis]) / REACH_M for axis in axes)
        return SIDE / 2.0 * (1.0 + right), SIDE / 2.0 * (1.0 - up)

    def _surface(self, geom: int) -> Array:
        """Return points, (n, 3), m, whose hull is that of a geom."""
        turned = self._data.geom_xmat[geom].reshape(3, 3)
        points = np.array([mat_vec(turned, point) for point in self._local[geom]])
        return np.asarray(points + self._data.geom_xpos[geom])


def local_points(model: mujoco.MjModel, geom: int) -> Array:
    """Return points on the surface of a geom, (n, 3), m, in its own frame; of a box or mesh the
    corners of its box."""
    kinds = mujoco.mjtGeom
    size = model.geom_size[geom]
    a, b, _ = size
    kind = kinds(int(model.geom_type[geom]))
    turns = [2.0 * math.pi * k / RIM for k in range(RIM)]
    ring = np.array([(math.cos(turn), math.sin(turn), 0.0) for turn in turns])
    up = np.array([0.0, 0.0, 1.0])
    if kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE):
        ends = [a * ring + b * up, a * ring - b * up]
        if kind == kinds.mjGEOM_CAPSULE:
            ends.append(np.array([(a + b) * up, -(a + b) * up]))
        return np.concatenate(ends)
    if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        axes = a if kind == kinds.mjGEOM_SPHERE else size
        return np.array(axes * np.concatenate([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]]))
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    return np.asarray(model.geom_aabb[geom, :3] + corners * model.geom_aabb[geom, 3:])


def hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the corners of the convex hull, in order (Andrew's monotone chain, 1979)."""
    ordered = sorted(set(points))

    def half(row: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in row:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept

    return ordered if len(ordered) < 3 else half(ordered)[:-1] + half(ordered[::-1])[:-1]
