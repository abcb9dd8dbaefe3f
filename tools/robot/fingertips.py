"""What the fingers of a gripper can take, and the tool between them, by rays on their surfaces: two
fingers, or one that closes on a jaw that stands still.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, norm
from rack.levels.errors import RobotError
from rack.levels.planning.collision import farthest
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import below
from rack.levels.tables import ToolConfig

STEP_M = 0.0025
"""Spacing of the places between the fingers that are tried."""
FROM_TIP_M = 0.012
"""Depth of the tool's origin between the fingers."""
ROOM_M = 0.001
"""From a jaw that stands still to the line along which places next to it are tried."""
BLOCK_PART = 0.5
FACING_PART = 0.35
"""Widths of a block in that between fingers, and between a jaw and a finger: one that turns faces
the jaw only when it is nearly closed."""
LEAST_GAP_M = 0.012
"""A gripper that opens less has no use for a block."""
NEARLY, NEARER = 0.6, 0.85
"""Parts of the way to closed, near enough to tell where the fingers will meet, and where a single
one meets its jaw: if it turns, its tip is there only when it is nearly closed."""
LEAST_WAY_M = 1e-4
FINGERS, STILL = np.eye(6, dtype=np.uint8)[1:3]
"""Groups of geoms, for rays: what closes; what a single finger closes on."""
ASIDE_M = (0.0, 0.01, -0.01, 0.02, -0.02)
"""Where a ray between the fingers starts, besides the middle: the two of three leave a gap."""
ALIGNED = 0.98
"""Cosine above which a direction is that of the body's axis."""
ABOUT = 0.9
"""The same for the way out to a single finger, whose middle is to one side of the hand's."""


class Fingertips(NamedTuple):
    """What two fingers, or a finger and a jaw, can take."""

    tool: ToolConfig  # z out of the hand, y across
    opening: float  # m or rad: the widest at which they face each other
    block: float  # width of a block for them, m
    below: float  # how far they reach beyond the tool, m
    is_one: bool  # one finger closes on a jaw that stands still
    out: Array  # (3,), z of the tool with the arm at its start


def find_fingertips(cell: Cell, tip: str, is_one: bool = False) -> Fingertips:
    """Return what the gripper can take; `is_one` is known of meshes cut to pieces. Raises
    `RobotError` where nothing closes, or not on a block.
    """
    fingers = _Fingers(cell, tip, is_one)
    out = fingers.out
    across = fingers.across
    between = [place for place in fingers.places() if np.isfinite(fingers.gap(place)).all()]
    if not between:
        raise RobotError("fingers that do not close on each other, nor on a jaw")
    origin = between[min(int(FROM_TIP_M / STEP_M), len(between) // 2)]
    left, right = fingers.gap(origin)
    if not fingers.is_one:
        origin = origin + 0.5 * (left - right) * across
    for part in np.linspace(0.0, fingers.near, 16 if fingers.is_one else 8):
        fingers.close(part)
        width = sum(fingers.gap(origin))
        if np.isfinite(width):
            break
    if not LEAST_GAP_M < width < np.inf:
        raise RobotError(
            f"fingers that open {1e3 * width:.0f} mm; {1e3 * LEAST_GAP_M:g} are needed"
        )
    block = BLOCK_PART * width
    if fingers.is_one:
        block = FACING_PART * width
        origin = origin + (0.5 * block - right) * across
    # Fingers that turn reach farther as they close.
    ends = []
    for step in np.linspace(part, 1.0, 5):
        fingers.close(step)
        ends.append(farthest(cell.model, fingers.data, fingers.geoms, out))
    reach = max(ends) - float(origin @ out)
    tool = _placed(fingers.data, cell.model.body(tip).id, origin, across, out)
    return Fingertips(tool, fingers.opening(float(part)), block, reach, fingers.is_one, out)


class _Fingers:
    """The solid geoms of a gripper, closed to one part after the other, and where they meet."""

    def __init__(self, cell: Cell, tip: str, is_one: bool) -> None:
        assert cell.gripper is not None, "there are fingers"
        model = cell.model
        self._model = model
        self._gripper = cell.gripper
        self.data = cell.start()
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        self.geoms = cell.geoms.gripper[solid[cell.geoms.gripper]]
        closed = self.close(1.0)
        ways = self.close(NEARLY) - closed
        moving = np.linalg.norm(ways, axis=1) > LEAST_WAY_M
        if not moving.any():
            raise RobotError("fingers that do not move")
        ways = ways[moving]
        self.is_one = is_one or bool((ways @ ways.T).min() >= 0.0)
        self.near = NEARER if self.is_one else NEARLY
        # Of the gripper, rays see what is solid, of the rest nothing.
        model.geom_group[:] = 0
        model.geom_group[self.geoms] = 1 + (self.is_one & ~moving)
        hand = model.body(tip).id
        axes = self.data.xmat[hand].reshape(3, 3).T
        half = self.close(self.near)[moving]
        if self.is_one:
            across = ways.mean(axis=0)
            self._middle = half.mean(axis=0)
            out = _snapped(closed[moving].mean(axis=0) - self.data.xpos[hand], axes, ABOUT)
        else:
            across = np.linalg.svd(ways - ways.mean(axis=0))[2][0]
            side = ways @ across > 0
            self._middle = 0.5 * (half[side].mean(axis=0) + half[~side].mean(axis=0))
            out = self._middle - self.data.xpos[hand]
            out = _snapped(out - across * (across @ out), axes)
        self.out = out  # (3,), of the hand
        self.across = _snapped(across - out * (across @ out), axes)  # (3,)

    def opening(self, part: float) -> float:
        """Return the position of the driven joint, m or rad."""
        return self._gripper.open + part * (self._gripper.closed - self._gripper.open)

    def close(self, part: float) -> Array:
        """Close the gripper to a part; return the middles of its geoms, (geoms, 3), m."""
        self._gripper.linkage.set(self.data.qpos, self.opening(part))
        mujoco.mj_forward(self._model, self.data)
        return np.array(self.data.geom_xpos[self.geoms])

    def gap(self, at: Array) -> tuple[float, float]:
        """Return the distances from a place to the fingers on both sides, m; inf: none."""
        other = STILL if self.is_one else FINGERS
        return self._ray(at, self.across, FINGERS), self._ray(at, -self.across, other)

    def places(self) -> list[Array]:
        """Return places between the fingers, the outermost first; of a single finger next to the
        jaw.
        """
        places = [self._middle + self.out * step * STEP_M for step in range(60, -40, -1)]
        if not self.is_one:
            return places
        # From inside the finger to next to the jaw, as it is near its tip.
        found = np.array([self._ray(place, -self.across, STILL) for place in places])
        at_tip = found[np.isfinite(found)][: int(FROM_TIP_M / STEP_M)]
        if not len(at_tip):
            return []
        return [place - (at_tip.min() - ROOM_M) * self.across for place in places]

    def _ray(self, at: Array, way: Array, group: NDArray[np.uint8]) -> float:
        starts = (at + aside * np.cross(self.across, self.out) for aside in ASIDE_M)
        rays = (
            mujoco.mj_ray(self._model, self.data, start, way, group, 1, -1, None)
            for start in starts
        )
        return next((distance for distance in rays if distance >= 0), np.inf)


def tool_outward(cell: Cell, body: str) -> tuple[str, ToolConfig | None]:
    """Return the tool of an arm that ends at a body, z along the last joint, outward: a site of the
    model, or a place on the body.
    """
    model = cell.model
    data = cell.start()
    at = data.xpos[model.body(body).id]
    axes = data.xmat[model.body(body).id].reshape(3, 3).T
    last, before = (int(model.dof_jntid[dof]) for dof in (cell.dof[-1], cell.dof[-2:][0]))
    out = data.xaxis[last]
    if out @ (at - data.xanchor[before]) < 0.0:
        out = -out
    out = _snapped(out, axes)
    carried = below(model, model.jnt_bodyid[[last]])[model.site_bodyid]
    carried[cell.tool] = False
    along = data.site_xmat[:, [2, 5, 8]] @ out > ALIGNED
    named = [model.site(site).name for site in np.flatnonzero(carried & along)]
    if sites := [str(name) for name in named if name]:
        return sites[-1], None
    side = axes[int(np.argmin(np.abs(axes @ out)))]
    side = side - out * (side @ out)
    side /= norm(side)
    return body, _placed(data, model.body(body).id, at, side, out)


def _snapped(way: Array, axes: Array, least: float = ALIGNED) -> Array:
    """Return a unit vector, that of an axis where it is about that."""
    way = way / norm(way)
    along = axes @ way
    best = int(np.argmax(np.abs(along)))
    return np.sign(along[best]) * axes[best] if abs(along[best]) > least else way


def _placed(data: mujoco.MjData, body: int, origin: Array, across: Array, out: Array) -> ToolConfig:
    """Return a frame of the world as one on a body: its origin, its y and its z axis, (3,) each."""
    turned = np.stack((np.cross(across, out), across, out), axis=1)
    own = data.xmat[body].reshape(3, 3)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (own.T @ turned).ravel())
    position = own.T @ (origin - data.xpos[body])
    frame = {"position": position.round(5).tolist(), "quaternion": quaternion.round(6).tolist()}
    return ToolConfig.model_validate(frame)
