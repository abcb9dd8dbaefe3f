"""Grasps of an object, and the poses in which it can stand."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.errors import Refused
from rack.levels.messages import Error
from rack.levels.planning.collision import farthest, place_bodies
from rack.levels.planning.moves import Situation
from rack.levels.planning.pose import Pose, pointing, pose, turned_about_z, yaw_of
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import geom_name
from rack.levels.task.program import DOWN, Transfer

UP = np.array([0.0, 0.0, 1.0])
QUARTERS = (0, 1, -1, 2)
"""Quarter turns between object and gripper, in the order of trying."""
TILTS_DEG = (*range(10, 91, 10), *range(15, 90, 10))
"""Angles from straight down at which the tool may take an object that it cannot take so, in the
order of trying."""
FULL_ORIENTATION = 6
"""Joints that bring the tool to a place in every orientation; one of fewer leans away from its
base alone."""
HEIGHT_STEP_M = 0.01
"""Spacing of grasps above the object's origin: a tall object is taken higher, so that the palm
stays clear."""
SET_DOWN_M = 0.0005
"""Gap between an object and its support when the gripper opens."""
SLIP_M = 0.006
"""What is added to it for a tool that leans: swung round, an object slips in the fingers by some
mm, and would then be pressed on its support."""
LEAST_LEAN = 0.01
"""1 - cosine of the least angle from straight down at which a tool leans."""
MAX_DISTANCE_M = 10.0
"""Range in which distances between geoms are measured."""
SKIN_M = 1e-6
"""A ray that has hit the arm continues this far inside the surface."""
MAX_STANDING_GAP_M = 0.02
"""A goal farther than this above or below a standing height is a mistake in the program."""


def grasps(cell: Cell, situation: Situation, row: int) -> Iterator[list[Pose]]:
    """Yield, from the lowest height up, the tool poses that take object `row`: straight down,
    then leaning over each of its sides.

    The fingers close along the tool's y axis, across the object's x or y axis.
    """
    seen = situation.object_pose(row)
    yaws = [yaw_of(seen.quaternion) + quarter * np.pi / 2.0 for quarter in QUARTERS]
    height = 0.0
    heights = []
    while height == 0.0 or seen.position[2] + height < _top(cell, situation, row):
        heights.append(height)
        yield [Pose(seen.raised(height).position, pointing(DOWN, -yaw)) for yaw in yaws]
        height += HEIGHT_STEP_M
    if len(cell.qpos) < FULL_ORIENTATION:
        yaws = [bearing(cell, seen.position)]
    for tilt in map(math.radians, TILTS_DEG):
        for height in heights[::2]:
            yield [Pose(seen.raised(height).position, leaning(yaw, tilt)) for yaw in yaws]


def leaning(yaw: float, tilt: float) -> Array:
    """Return the quaternion of a tool that points down but for `tilt`, rad, towards `yaw`; its y
    axis is level.
    """
    across = math.sin(tilt)
    return pointing((across * math.cos(yaw), across * math.sin(yaw), -math.cos(tilt)), yaw)


def leans(tool: Pose) -> bool:
    """Return whether a tool does not point straight down."""
    along = np.zeros(3)
    mujoco.mju_rotVecQuat(along, UP, tool.quaternion)
    return bool(1.0 + along[2] > LEAST_LEAN)


def bearing(cell: Cell, position: Array) -> float:
    """Return the direction, rad, in which the arm's first joint sees a position."""
    base = cell.start().xanchor[cell.model.dof_jntid[cell.dof[0]]]
    return math.atan2(position[1] - base[1], position[0] - base[0])


def goals(action: Transfer, at: Pose, cell: Cell) -> Iterator[list[Pose]]:
    """Yield the poses in which the object may be put down, in the order of trying: upright as it is
    now, turned about the vertical by quarters, then by what lies between.
    """
    yaw = yaw_of(at.quaternion)
    if action.yaw is not None:
        yield [_turned(action, at, action.yaw - yaw)]
        return
    turns = [quarter * np.pi / 2.0 for quarter in QUARTERS]
    between = [turn + part * np.pi / 8.0 for part in (2, 1, 3) for turn in turns]
    if len(cell.qpos) < FULL_ORIENTATION:
        turns.append(bearing(cell, np.array(action.to)) - bearing(cell, at.position))
    for group in (turns, between):
        yield [_turned(action, at, turn) for turn in group]


def _turned(action: Transfer, at: Pose, turn: float) -> Pose:
    """Return the pose of an object at its goal, turned by `turn`, rad, from how it is now."""
    quaternion = np.zeros(4)
    mujoco.mju_mulQuat(quaternion, turned_about_z(turn), at.quaternion)
    return pose(action.to, quaternion)


def standing(cell: Cell, data: mujoco.MjData, row: int, situation: Situation) -> Pose:
    """Return the pose of object `row` in `situation`, for which `data` is changed, at the height at
    which it stands on the support below it.

    Raises `Refused` for a goal over no support, or far above or below one.
    """
    model = cell.model
    _lay_out(cell, data, situation)
    goal = situation.object_pose(row)
    name = model.body(cell.bodies[row]).name
    x, y, z = goal.position
    support = _geom_below(cell, data, row, goal.position)
    if support not in cell.geoms.supports:
        supports = ", ".join(f"'{geom_name(model, g)}'" for g in cell.geoms.supports) or "none"
        place = f"over '{geom_name(model, support)}'" if support >= 0 else "over nothing"
        raise Refused(
            Error.UNREACHABLE,
            f"at [{x:.3f}, {y:.3f}] '{name}' would be {place}; supports: {supports}",
        )
    gap = min(
        mujoco.mj_geomDistance(model, data, int(part), support, MAX_DISTANCE_M, None)
        for part in cell.parts(row)
    )
    if abs(gap) > MAX_STANDING_GAP_M:
        side = "above" if gap > 0 else "deep in"
        place = f"{abs(gap) * 1e3:.0f} mm {side} '{geom_name(model, support)}'"
        raise Refused(
            Error.UNREACHABLE, f"at z = {z:.3f} '{name}' would be {place}; valid z: {z - gap:.3f}"
        )
    return goal.raised(SET_DOWN_M - gap)


def _geom_below(cell: Cell, data: mujoco.MjData, row: int, point: Array) -> int:
    """Return the first geom below `point` that is neither object `row` nor the arm; -1: there is
    none.
    """
    found = np.full(1, -1, dtype=np.int32)
    body = int(cell.bodies[row])
    begin = point.copy()
    while True:
        distance = mujoco.mj_ray(cell.model, data, begin, np.array(DOWN), None, 1, body, found)
        if found[0] not in cell.geoms.arm:
            return int(found[0])
        begin[2] -= distance + SKIN_M


def _lay_out(cell: Cell, data: mujoco.MjData, situation: Situation) -> None:
    """Place the bodies in `data` as in `situation`."""
    place_bodies(cell, data, situation.positions, situation.quaternions)
    mujoco.mj_kinematics(cell.model, data)


def _top(cell: Cell, situation: Situation, row: int) -> float:
    """Return the height of the highest point of object `row`, from its bounding boxes, in m."""
    data = cell.start()
    _lay_out(cell, data, situation)
    return farthest(cell.model, data, cell.parts(row), UP)
