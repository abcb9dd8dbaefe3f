"""Grasps of an object, and the poses in which it can stand."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.errors import Refused
from rack.levels.messages import Error
from rack.levels.planning.collision import compute_extent, place_bodies
from rack.levels.planning.moves import Situation
from rack.levels.planning.pose import (
    Pose,
    build_pointing_quaternion,
    build_yaw_quaternion,
    compute_yaw,
    make_pose,
)
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import find_geom_name
from rack.levels.task.program import DOWN, Transfer

UP = np.array([0.0, 0.0, 1.0])
QUARTER_TURNS = (0, 1, -1, 2)
"""Quarter turns between object and gripper, in the order in which they are tried."""
TILTS_DEG = (*range(10, 91, 10), *range(15, 90, 10))
"""Angles between the tool and straight down, in the order in which they are tried.

They are tried only if an object cannot be taken from straight above.
"""
FULL_ORIENTATION = 6
"""Number of joints with which the tool reaches a place in every orientation.

An arm with fewer joints can only lean away from its base.
"""
HEIGHT_STEP_M = 0.01
"""Spacing of grasps above the object's origin.

A tall object is taken higher, so that the palm does not touch it.
"""
SET_DOWN_M = 0.0005
"""Gap between an object and its support when the gripper opens."""
SLIP_M = 0.006
"""Addition to `SET_DOWN_M` for a tool that leans.

An object that is swung around slips in the fingers by some millimetres, and would otherwise be
pressed onto its support.
"""
MIN_LEAN = 0.01
"""1 - cosine of the angle from straight down above which a tool counts as leaning."""
MAX_DISTANCE_M = 10.0
"""Range, in m, within which distances between geoms are measured."""
SKIN_M = 1e-6
"""Distance by which a ray that has hit the arm continues inside the surface."""
MAX_STANDING_GAP_M = 0.02
"""Largest distance of a goal from the standing height. Beyond it the program is refused."""


def find_grasps(cell: Cell, situation: Situation, row: int) -> Iterator[list[Pose]]:
    """Yield groups of tool poses that grasp object `row`, in the order in which to try them.

    The first groups point straight down, from the lowest height up. In the following groups, the
    tool leans over one side of the object. The fingers close along the tool's y axis, across the
    object's x or y axis.
    """
    seen = situation.object_pose(row)
    yaws = [compute_yaw(seen.quaternion) + quarter * np.pi / 2.0 for quarter in QUARTER_TURNS]
    data = cell.build_start_data()
    _place_bodies(cell, data, situation)
    top = compute_extent(cell.model, data, cell.list_geoms(row), UP)
    height = 0.0
    heights = []
    while height == 0.0 or seen.position[2] + height < top:
        heights.append(height)
        yield [
            Pose(seen.raise_by(height).position, build_pointing_quaternion(DOWN, -yaw))
            for yaw in yaws
        ]
        height += HEIGHT_STEP_M
    if len(cell.qpos) < FULL_ORIENTATION:
        yaws = [compute_bearing(cell, seen.position)]
    for tilt in map(math.radians, TILTS_DEG):
        # The tool points down, tilted towards `yaw`. Its y axis is horizontal.
        across = math.sin(tilt)
        leaning = [
            build_pointing_quaternion(
                (across * math.cos(yaw), across * math.sin(yaw), -math.cos(tilt)), yaw
            )
            for yaw in yaws
        ]
        for height in heights[::2]:
            position = seen.raise_by(height).position
            yield [Pose(position, quaternion) for quaternion in leaning]


def is_leaning(tool: Pose) -> bool:
    """Return True if a tool does not point straight down."""
    return bool(1.0 + tool.rotate_vector(UP)[2] > MIN_LEAN)


def compute_bearing(cell: Cell, position: Array) -> float:
    """Return the horizontal direction from the arm's first joint to a position, in rad."""
    base = cell.build_start_data().xanchor[cell.model.dof_jntid[cell.dof[0]]]
    return math.atan2(position[1] - base[1], position[0] - base[0])


def find_goals(action: Transfer, at: Pose, cell: Cell) -> Iterator[list[Pose]]:
    """Yield groups of poses in which the object may be put down, in the order in which to try them.

    The object stays upright. If the action specifies no angle, the first group turns the object
    about the vertical by quarter turns, and the second group by angles in between.

    Args:
        action: The transfer.
        at: Pose of the object before the transfer.
        cell: The cell.
    """
    yaw = compute_yaw(at.quaternion)
    if action.yaw is not None:
        yield [_build_turned_pose(action, at, action.yaw - yaw)]
        return
    turns = [quarter * np.pi / 2.0 for quarter in QUARTER_TURNS]
    between = [turn + eighths * np.pi / 8.0 for eighths in (2, 1, 3) for turn in turns]
    if len(cell.qpos) < FULL_ORIENTATION:
        turns.append(
            compute_bearing(cell, np.array(action.to)) - compute_bearing(cell, at.position)
        )
    for group in (turns, between):
        yield [_build_turned_pose(action, at, turn) for turn in group]


def _build_turned_pose(action: Transfer, at: Pose, turn: float) -> Pose:
    """Return the pose of an object at its goal, turned by `turn` rad from its present pose `at`."""
    quaternion = np.zeros(4)
    mujoco.mju_mulQuat(quaternion, build_yaw_quaternion(turn), at.quaternion)
    return make_pose(action.to, quaternion)


def find_standing_pose(cell: Cell, data: mujoco.MjData, row: int, situation: Situation) -> Pose:
    """Return the goal pose of an object, at the height at which it stands on its support.

    Args:
        cell: The cell.
        data: Work space, which is changed.
        row: Row of the object in the world model.
        situation: Poses of the objects, with the object at its goal.

    Raises:
        Refused: The goal is not over a support, or too far above or below the standing height.
    """
    model = cell.model
    _place_bodies(cell, data, situation)
    goal = situation.object_pose(row)
    name = model.body(cell.bodies[row]).name
    x, y, z = goal.position
    support = _find_geom_below(cell, data, row, goal.position)
    if support not in cell.geoms.supports:
        supports = ", ".join(f"'{find_geom_name(model, g)}'" for g in cell.geoms.supports) or "none"
        place = f"over '{find_geom_name(model, support)}'" if support >= 0 else "over nothing"
        raise Refused(
            Error.UNREACHABLE,
            f"at [{x:.3f}, {y:.3f}] '{name}' would be {place}; supports: {supports}",
        )
    gap = min(
        mujoco.mj_geomDistance(model, data, int(geom), support, MAX_DISTANCE_M, None)
        for geom in cell.list_geoms(row)
    )
    if abs(gap) > MAX_STANDING_GAP_M:
        side = "above" if gap > 0 else "deep in"
        place = f"{abs(gap) * 1e3:.0f} mm {side} '{find_geom_name(model, support)}'"
        raise Refused(
            Error.UNREACHABLE, f"at z = {z:.3f} '{name}' would be {place}; valid z: {z - gap:.3f}"
        )
    return goal.raise_by(SET_DOWN_M - gap)


def _find_geom_below(cell: Cell, data: mujoco.MjData, row: int, point: Array) -> int:
    """Return the id of the first geom below a point, or -1 if there is none.

    Geoms of the arm and of object `row` are ignored.
    """
    geom = np.full(1, -1, dtype=np.int32)
    body = int(cell.bodies[row])
    begin = point.copy()
    while True:
        distance = mujoco.mj_ray(cell.model, data, begin, np.array(DOWN), None, 1, body, geom)
        if geom[0] not in cell.geoms.arm:
            return int(geom[0])
        begin[2] -= distance + SKIN_M


def _place_bodies(cell: Cell, data: mujoco.MjData, situation: Situation) -> None:
    """Set the poses of the bodies in `data` to their poses in `situation`."""
    place_bodies(cell, data, situation.positions, situation.quaternions)
    mujoco.mj_kinematics(cell.model, data)
