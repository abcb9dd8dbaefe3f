"""Measures by ray casting what a gripper can grasp, and places the tool between its fingers.

Two kinds are supported: fingers that close on each other, and one that closes on a fixed jaw.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, norm
from rack.levels.errors import RobotError
from rack.levels.planning.collision import compute_extent
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import mark_descendants
from rack.levels.tables import ToolConfig

STEP_M = 0.0025
"""Spacing of the points between the fingers at which rays are cast."""
FROM_TIP_M = 0.012
"""Distance of the tool's origin from the tips of the fingers."""
JAW_CLEARANCE_M = 0.001
"""Distance from the surface of a fixed jaw to the line of points that are tried."""
BLOCK_FRACTION = 0.5
JAW_BLOCK_FRACTION = 0.35
"""Width of a block as a fraction of the gap, with two fingers, and with one finger and a jaw.

A finger that turns faces its jaw only when it is nearly closed.
"""
MIN_GAP_M = 0.012
"""Minimum opening of a gripper that can grasp a block."""
NEARLY_CLOSED, NEARLY_CLOSED_ON_JAW = 0.6, 0.85
"""Closed fractions at which the meeting point is measured: for two fingers, and for one finger.

The tip of a single turning finger is near its jaw only when it is nearly closed.
"""
MIN_FINGER_MOTION_M = 1e-4
"""A geom that moves less than this does not belong to a finger."""
FINGER_GROUP, JAW_GROUP = np.eye(6, dtype=np.uint8)[1:3]
"""Geom groups that a ray can hit: moving fingers, and the jaw that a single finger closes on."""
RAY_OFFSETS_M = (0.0, 0.01, -0.01, 0.02, -0.02)
"""Sideways offsets at which rays start, in order: the middle of three fingers may miss the others.
"""
ALIGNED_COSINE = 0.98
"""Cosine above which a direction is replaced by the axis of the body."""
LOOSELY_ALIGNED_COSINE = 0.9
"""Like `ALIGNED_COSINE`, for the direction to a single finger, which is beside the hand's centre.
"""


class Fingertips(NamedTuple):
    """Measurements of two fingers, or of a finger and a jaw, that limit what they can grasp."""

    tool: ToolConfig  # z out of the hand, y across
    opening: float  # m or rad: the widest at which they face each other
    block_width: float  # width of a block for them, m
    length_below: float  # length of the fingers beyond the tool, m
    has_one_finger: bool  # True for one finger that closes on a fixed jaw
    out: Array  # (3,), z of the tool with the arm at its start


def measure_fingertips(cell: Cell, tip: str, has_one_finger: bool = False) -> Fingertips:
    """Measure opening and reach of a gripper, and define a tool frame between its fingers.

    Args:
        cell: The arm with its gripper.
        tip: Body that carries the gripper.
        has_one_finger: True if one finger and a fixed jaw were found before the meshes were cut.

    Raises:
        RobotError: The fingers do not close on each other or on a jaw, or open too little.
    """
    fingers = _Fingers(cell, tip, has_one_finger)
    out = fingers.out
    across = fingers.across
    points = [
        place for place in fingers.list_points() if np.isfinite(fingers.measure_gap(place)).all()
    ]
    if not points:
        raise RobotError("the fingers close neither on each other nor on a jaw")
    origin = points[min(int(FROM_TIP_M / STEP_M), len(points) // 2)]
    left, right = fingers.measure_gap(origin)
    if not fingers.is_one:
        origin = origin + 0.5 * (left - right) * across
    for fraction in np.linspace(0.0, fingers.near, 16 if fingers.is_one else 8):
        fingers.close(fraction)
        width = sum(fingers.measure_gap(origin))
        if np.isfinite(width):
            break
    if not MIN_GAP_M < width < np.inf:
        raise RobotError(
            f"the fingers open by {1e3 * width:.0f} mm; {1e3 * MIN_GAP_M:g} mm are needed"
        )
    block = BLOCK_FRACTION * width
    if fingers.is_one:
        block = JAW_BLOCK_FRACTION * width
        origin = origin + (0.5 * block - right) * across
    # Turning fingers reach farther out as they close.
    reaches = []
    for step in np.linspace(fraction, 1.0, 5):
        fingers.close(step)
        reaches.append(compute_extent(cell.model, fingers.data, fingers.geoms, out))
    reach = max(reaches) - float(origin @ out)
    tool = _to_body_frame(fingers.data, cell.model.body(tip).id, origin, across, out)
    return Fingertips(
        tool, fingers.to_joint_position(float(fraction)), block, reach, fingers.is_one, out
    )


class _Fingers:
    """Solid geoms of a gripper, which can be moved between open and closed."""

    def __init__(self, cell: Cell, tip: str, is_one: bool) -> None:
        assert cell.gripper is not None, "there are fingers"
        model = cell.model
        self._model = model
        self._gripper = cell.gripper
        self.data = cell.build_start_data()
        solid = (model.geom_contype | model.geom_conaffinity) != 0
        self.geoms = cell.geoms.gripper[solid[cell.geoms.gripper]]
        closed = self.close(1.0)
        displacements = self.close(NEARLY_CLOSED) - closed
        is_moving = np.linalg.norm(displacements, axis=1) > MIN_FINGER_MOTION_M
        if not is_moving.any():
            raise RobotError("the fingers do not move")
        displacements = displacements[is_moving]
        self.is_one = is_one or bool((displacements @ displacements.T).min() >= 0.0)
        self.near = NEARLY_CLOSED_ON_JAW if self.is_one else NEARLY_CLOSED
        # Rays hit the solid geoms of the gripper and nothing else.
        model.geom_group[:] = 0
        model.geom_group[self.geoms] = 1 + (self.is_one & ~is_moving)
        hand = model.body(tip).id
        axes = self.data.xmat[hand].reshape(3, 3).T
        nearly_closed = self.close(self.near)[is_moving]
        if self.is_one:
            across = displacements.mean(axis=0)
            self._middle = nearly_closed.mean(axis=0)
            out = _snap_to_axis(
                closed[is_moving].mean(axis=0) - self.data.xpos[hand], axes, LOOSELY_ALIGNED_COSINE
            )
        else:
            across = np.linalg.svd(displacements - displacements.mean(axis=0))[2][0]
            side = displacements @ across > 0
            self._middle = 0.5 * (
                nearly_closed[side].mean(axis=0) + nearly_closed[~side].mean(axis=0)
            )
            out = self._middle - self.data.xpos[hand]
            out = _snap_to_axis(out - across * (across @ out), axes)
        self.out = out  # (3,), of the hand
        self.across = _snap_to_axis(across - out * (across @ out), axes)  # (3,)

    def to_joint_position(self, closed_fraction: float) -> float:
        """Convert a closed fraction to a position of the driven joint in m or rad.

        The fraction is 0 for open and 1 for closed.
        """
        return self._gripper.open + closed_fraction * (self._gripper.closed - self._gripper.open)

    def close(self, closed_fraction: float) -> Array:
        """Close the gripper by a fraction from 0 to 1.

        Returns the centres of its geoms, (geoms, 3), in m.
        """
        self._gripper.linkage.set_opening(self.data.qpos, self.to_joint_position(closed_fraction))
        mujoco.mj_forward(self._model, self.data)
        return np.array(self.data.geom_xpos[self.geoms])

    def measure_gap(self, at: Array) -> tuple[float, float]:
        """Measure the distances in m from a point to the finger or jaw on each side.

        A distance is infinite if there is neither in that direction.
        """
        other = JAW_GROUP if self.is_one else FINGER_GROUP
        return self._cast_ray(at, self.across, FINGER_GROUP), self._cast_ray(
            at, -self.across, other
        )

    def list_points(self) -> list[Array]:
        """List points between the fingers, or beside a fixed jaw, outermost first."""
        points = [self._middle + self.out * step * STEP_M for step in range(60, -40, -1)]
        if not self.is_one:
            return points
        # Move the points from inside the finger to the surface of the jaw near its tip.
        distances = np.array([self._cast_ray(point, -self.across, JAW_GROUP) for point in points])
        at_tip = distances[np.isfinite(distances)][: int(FROM_TIP_M / STEP_M)]
        if not len(at_tip):
            return []
        return [point - (at_tip.min() - JAW_CLEARANCE_M) * self.across for point in points]

    def _cast_ray(self, point: Array, direction: Array, group: NDArray[np.uint8]) -> float:
        """Return the distance in m to the first geom of a group in a direction, or infinity."""
        starts = (point + aside * np.cross(self.across, self.out) for aside in RAY_OFFSETS_M)
        rays = (
            mujoco.mj_ray(self._model, self.data, start, direction, group, 1, -1, None)
            for start in starts
        )
        return next((distance for distance in rays if distance >= 0), np.inf)


def choose_outward_tool(cell: Cell, body: str) -> tuple[str, ToolConfig | None]:
    """Choose a tool frame whose z axis is along the last joint's axis, away from the arm.

    Args:
        cell: The arm.
        body: Body at the end of the arm.

    Returns:
        Name of a suitable site and None, or name of the body and the tool's pose relative to it.
    """
    model = cell.model
    data = cell.build_start_data()
    at = data.xpos[model.body(body).id]
    axes = data.xmat[model.body(body).id].reshape(3, 3).T
    last, before = (int(model.dof_jntid[dof]) for dof in (cell.dof[-1], cell.dof[-2:][0]))
    out = data.xaxis[last]
    if out @ (at - data.xanchor[before]) < 0.0:
        out = -out
    out = _snap_to_axis(out, axes)
    carried = mark_descendants(model, model.jnt_bodyid[[last]])[model.site_bodyid]
    carried[cell.tool] = False
    along = data.site_xmat[:, [2, 5, 8]] @ out > ALIGNED_COSINE
    named = [model.site(site).name for site in np.flatnonzero(carried & along)]
    if sites := [str(name) for name in named if name]:
        return sites[-1], None
    side = axes[int(np.argmin(np.abs(axes @ out)))]
    side = side - out * (side @ out)
    side /= norm(side)
    return body, _to_body_frame(data, model.body(body).id, at, side, out)


def _snap_to_axis(direction: Array, axes: Array, min_cosine: float = ALIGNED_COSINE) -> Array:
    """Normalize a direction, and replace it by the nearest axis if they are almost parallel.

    Args:
        direction: The direction, (3,).
        axes: Candidates, (3, 3), one in each row.
        min_cosine: Minimum cosine of the angle to an axis that replaces the direction.
    """
    direction = direction / norm(direction)
    along = axes @ direction
    nearest = int(np.argmax(np.abs(along)))
    is_aligned = abs(along[nearest]) > min_cosine
    return np.sign(along[nearest]) * axes[nearest] if is_aligned else direction


def _to_body_frame(
    data: mujoco.MjData, body: int, origin: Array, across: Array, out: Array
) -> ToolConfig:
    """Convert a tool frame from world to body coordinates.

    Args:
        data: Simulation data with the pose of the body.
        body: Id of the body.
        origin: Origin of the tool frame, (3,), in m.
        across: Its y axis, (3,).
        out: Its z axis, (3,).
    """
    axes = np.stack((np.cross(across, out), across, out), axis=1)
    body_axes = data.xmat[body].reshape(3, 3)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, (body_axes.T @ axes).ravel())
    position = body_axes.T @ (origin - data.xpos[body])
    frame = {"position": position.round(5).tolist(), "quaternion": quaternion.round(6).tolist()}
    return ToolConfig.model_validate(frame)
