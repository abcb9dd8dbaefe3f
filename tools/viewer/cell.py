"""Writes the cell in 3D: geoms, poses of moving bodies, planned path and goals.

The arm is red while its brakes are engaged, and balls mark faults. Each geom is written only once,
in the frame of its body.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rack.boards.events import Event
from rack.levels.algebra import Array
from rack.levels.messages import SegmentKind, Verb
from rack.levels.robot.cell import Cell
from rack.levels.robot.engine import view_state
from rack.tools.viewer.levels import format_enum
from rack.tools.viewer.shapes import (
    Shape,
    build_shape,
    colour_shape,
    convert_to_xyzw,
    read_colour,
    remove_colour,
)
from rack.tools.viewer.stream import (
    Moment,
    RowBlock,
    Stream,
    ViewPart,
    build_change_finder,
)
from rack.tools.viewer.style import CURRENT, GOAL, LOST, PLANNED, pack_colours

CELL = "cell"
FRAMES = "frames"
WORLD = "world"
SHOWN_S = 0.02
"""Simulated time between two drawn poses, about the refresh interval of a screen."""
SHOWN_GROUPS = 3
"""Number of geom groups that are shown.

MuJoCo's own viewer shows groups 0, 1 and 2. By convention, higher groups contain collision shapes.
"""
PATH = (CELL, "planned_path")
WAYPOINTS = (CELL, "way_points")
GOALS = (CELL, "goals")
CURRENT_GOAL = (CELL, "current_goal")
STEP_RAD = 0.03
"""Largest motion of a joint between two points of a drawn path.

On a straight line in joint space the tool moves along a curve, so the path is drawn in short
pieces.
"""
POINT_M = 0.008
LABEL = 0xFFFFFFFF
LINE_M = 0.003
BRAKES = (CELL, "brakes")
BRAKE_LABELS = {"brakes_closed": "brakes engaged", "brakes_opened": ""}
"""Label of the arm by code of an event."""
FAULTS = (CELL, "faults")
MARK_PART = 0.09
"""Radius of a mark, relative to the radius of arm and objects.

Marks are thicker than a link, so that they are visible.
"""
AXES = (CELL, "axes")
AXES_PART = 0.25
AXES_RADIUS_PART = 0.0125
AXES_BESIDE = np.array([-0.6, -0.45, 0.0])
"""Length, radius and position of the axes, relative to the radius of arm and objects.

The axes are left of the arm.
"""
AXES_COLOURS = (0xE64646FF, 0x46B45AFF, 0x468CE6FF)


def name_frame(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body's coordinate frame in the recording."""
    return WORLD if body == 0 else f"body/{model.body(body).name or body}"


class ArmShape(NamedTuple):
    """A shape of the arm.

    Attributes:
        entity: Its entity in the recording.
        shape: The shape without its colour.
        colour: Red, green, blue and alpha while the brakes are released.
    """

    entity: tuple[str, ...]
    shape: Shape
    colour: NDArray[np.uint8]


def write_geometry(stream: Stream, cell: Cell) -> list[ArmShape]:
    """Write everything that never changes: geoms, poses of fixed bodies, and the world's axes.

    Returns:
        The visible shapes of the arm, whose colours are still to be written.
    """
    model = cell.model
    data = cell.build_start_data()
    stream.log_static((CELL,), stream.build_frame(WORLD))
    centre, radius = compute_extent(cell)
    begin = centre + radius * AXES_BESIDE
    begin[2] = find_floor_height(cell)
    axes = rr.Arrows3D(
        origins=[begin] * 3,
        vectors=AXES_PART * radius * np.eye(3),
        radii=AXES_RADIUS_PART * radius,
        colors=pack_colours(AXES_COLOURS),
        labels=["x", "y", "z"],
    )
    stream.log_static(AXES, axes, stream.build_frame(WORLD))
    is_shown = model.geom_group < SHOWN_GROUPS
    if not is_shown.any():
        is_shown[:] = True
    arm = []
    for geom in np.flatnonzero(is_shown).tolist():
        shape = build_shape(model, geom)
        if shape is not None:
            body = int(model.geom_bodyid[geom])
            name = model.geom(geom).name or f"geom {geom}"
            entity = (CELL, model.body(body).name or f"body {body}", name)
            if geom in cell.geoms.arm:
                remove_colour(shape)
                arm.append(ArmShape(entity, shape, read_colour(model, geom)))
            stream.log_static(entity, shape, stream.build_frame(name_frame(model, body)))
    for body in np.flatnonzero(model.body_weldid == 0)[1:].tolist():
        name = name_frame(model, body)
        pose = rr.Transform3D(
            translation=data.xpos[body],
            quaternion=rr.Quaternion(xyzw=convert_to_xyzw(data.xquat[body])),
            parent_frame=stream.format_frame(WORLD),
            child_frame=stream.format_frame(name),
        )
        stream.log_static((FRAMES, name), pose)
    return arm


def build_pose_part(stream: Stream, cell: Cell) -> ViewPart:
    """Return the view part that shows the poses of all moving bodies from `ArmState` messages.

    The poses are computed by MuJoCo's kinematics, at most once per 20 ms of simulated time.
    """
    model = cell.model
    data = cell.build_start_data()
    # Bodies with joints or mocap poses, and all bodies attached to them.
    bodies = np.flatnonzero(model.body_weldid)
    world = stream.format_frame(WORLD)
    frames = [stream.format_frame(name_frame(model, body)) for body in bodies.tolist()]
    every = max(1, round(SHOWN_S * 1e9 / stream.times.clock_ns))
    last = -1

    def write(block: RowBlock) -> None:
        """Write the poses in the first row of each interval. Intervals may span blocks."""
        nonlocal last
        slots, first = np.unique(block.ticks // every, return_index=True)
        chosen = first[slots > last]
        last = int(slots[-1])
        if not len(bodies) or not len(chosen):
            return
        poses = np.empty((len(chosen), len(bodies), 7))
        for row, state in enumerate(block.messages["state"][chosen]):
            view_state(model, data, state)
            mujoco.mj_kinematics(model, data)
            poses[row] = np.hstack((data.xpos[bodies], data.xquat[bodies]))
        translations, quaternions = np.split(poses.reshape(-1, 7), [3], axis=1)
        columns = rr.Transform3D.columns(
            translation=translations,
            quaternion=convert_to_xyzw(quaternions),
            parent_frame=[world] * len(translations),
            child_frame=frames * len(chosen),
        )
        times = block.build_time_columns(np.repeat(chosen, len(bodies)))
        stream.send_columns((FRAMES,), times, columns)

    return write


class MarkWriter:
    """Colours the arm red while its brakes are engaged, and marks faults with red balls at joints.

    Args:
        stream: Stream to write to.
        cell: Cell of the arm.
        joints: Names of the joints.
        drivers: Tasks that drive the arm.
        arm: Shapes of the arm.
    """

    def __init__(
        self,
        stream: Stream,
        cell: Cell,
        joints: Sequence[str],
        drivers: Sequence[str],
        arm: Sequence[ArmShape],
    ) -> None:
        self._stream = stream
        self._drivers = drivers
        self._arm = arm
        self._braking_rows = build_change_finder()
        # Joint and text of each active fault, by its number in the fault table.
        self._faults: dict[int, tuple[str, str]] = {}
        self._joints = {name: cell.model.joint(name).pos for name in joints}
        self._radius = MARK_PART * compute_extent(cell)[1]
        for entity, name in ((BRAKES, joints[-1]), *(((*FAULTS, name), name) for name in joints)):
            body = int(cell.model.joint(name).bodyid[0])
            stream.log_static(entity, stream.build_frame(name_frame(cell.model, body)))
        self._mark_brakes(stream.times.estimate_moment(0), "")

    def write(self, block: RowBlock) -> None:
        """Colour the arm red when the brakes engage, and as before when they are released."""
        braked = block.messages["braked"]
        for row in np.union1d(self._braking_rows(braked), np.flatnonzero(block.resumed)):
            self._mark_brakes(block.find_moment(row), "brakes engaged" if braked[row] else "")

    def mark_lost(self, when: Moment, task: str) -> None:
        """Colour the arm red if the lost task drives it: without torque, the brakes engage."""
        if task in self._drivers:
            self._mark_brakes(when, f"brakes engaged: {task} is lost")

    def _mark_brakes(self, when: Moment, text: str) -> None:
        """Colour the arm red and label its last joint, or undo both if the text is empty."""
        for entity, shape, colour in self._arm:
            self._stream.log_at(when, entity, colour_shape(shape, LOST if text else colour))
        *_, place = self._joints.values()
        self._log_point(when, BRAKES, place, text, POINT_M, LABEL)

    def _log_point(
        self,
        when: Moment,
        entity: tuple[str, ...],
        place: Array,
        text: str,
        radius: float,
        colour: int,
    ) -> None:
        """Write a labelled point, or clear it if the text is empty."""
        points, labels = ([place], [text]) if text else ([], None)
        point = rr.Points3D(points, radii=radius, colors=[colour], labels=labels)
        self._stream.log_at(when, entity, point)

    def mark_event(self, when: Moment, event: Event) -> None:
        """Mark a joint from the beginning to the end of a fault, and the arm while it is braked.

        If a fault concerns no joint, the first joint is marked.
        """
        if event.code in BRAKE_LABELS:
            self._mark_brakes(when, BRAKE_LABELS[event.code])
        if event.kind != "fault":
            return
        joint = event.subject if event.subject in self._joints else next(iter(self._joints))
        if event.code == "begins":
            text = event.text.partition(" begins")[0]
            self._faults[event.fault] = joint, f"fault of {event.board}: {text}"
        else:
            self._faults.pop(event.fault, None)
        texts = dict(self._faults.values())
        for name, place in self._joints.items():
            entity = (*FAULTS, name)
            self._log_point(when, entity, place, texts.get(name, ""), self._radius, LOST)


def compute_extent(cell: Cell) -> tuple[Array, float]:
    """Return centre and radius in m of a sphere that encloses the arm and the objects.

    The centre has shape (3,).
    """
    data = cell.build_start_data()
    model = cell.model
    geoms = np.union1d(
        cell.geoms.arm, np.flatnonzero(np.isin(model.geom_bodyid, cell.bodies))
    ).astype(int)
    if not len(geoms):
        return model.stat.center, float(model.stat.extent)
    radii = model.geom_rbound[geoms, None]
    low = (data.geom_xpos[geoms] - radii).min(axis=0)
    high = (data.geom_xpos[geoms] + radii).max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def find_floor_height(cell: Cell) -> float:
    """Return the height of the floor in m, or 0 if the cell has no floor below the origin."""
    floors = np.flatnonzero(cell.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    return float(cell.build_start_data().geom_xpos[floors, 2].min(initial=0.0))


def build_path_part(stream: Stream, cell: Cell) -> ViewPart:
    """Return the view part that shows a `MovePlan` as path of the tool with way points.

    The path is shown from the tick at which the plan becomes visible. A plan without a path, for
    example for the gripper, clears the path.
    """
    data = cell.build_start_data()
    for entity in (PATH, WAYPOINTS):
        stream.log_static(entity, stream.build_frame(WORLD))

    def tool_at(joints: Array) -> Array:
        """Return the position of the tool in m, shape (3,), at joint positions in rad."""
        data.qpos[cell.qpos] = joints
        mujoco.mj_kinematics(cell.model, data)
        return np.array(data.site_xpos[cell.tool])

    def write(block: RowBlock) -> None:
        """Write the path of every plan in a block of messages."""
        for row, plan in enumerate(block.messages):
            way_points = plan["waypoints"][: plan["count"]]
            if plan["kind"] != SegmentKind.PATH or plan["error"]:
                way_points = way_points[:0]
            points = [tool_at(joints) for joints in way_points]
            lines = [[tool_at(joints) for joints in subdivide_path(way_points)]] if points else []
            when = block.find_visible_moment(row)
            stream.log_at(when, PATH, rr.LineStrips3D(lines, radii=LINE_M, colors=[PLANNED]))
            stream.log_at(when, WAYPOINTS, rr.Points3D(points, radii=POINT_M, colors=[PLANNED]))

    return write


def subdivide_path(corners: Array) -> Array:
    """Add points to a joint path, so that no joint moves more than `STEP_RAD` between neighbours.

    Args:
        corners: Joint positions in rad, shape (points, joints).

    Returns:
        The path with the additional points, shape (more points, joints).
    """
    longest = np.abs(np.diff(corners, axis=0)).max(axis=1)
    counts = np.maximum(np.ceil(longest / STEP_RAD), 1)
    numbers = np.concatenate(([0], np.cumsum(counts)))  # index of each corner among all points
    points = np.arange(numbers[-1] + 1)
    return np.column_stack([np.interp(points, numbers, joint) for joint in corners.T])


class GoalWriter:
    """Writes the points at which a `TaskPlan` releases objects, and the current move's goal."""

    def __init__(self, stream: Stream, objects: Sequence[str]) -> None:
        self._stream = stream
        self._objects = objects
        self._goals: dict[int, tuple[list[float], str]] = {}  # position and label, by move
        self._planned_rows = build_change_finder()
        self._current_rows = build_change_finder()
        for entity in (GOALS, CURRENT_GOAL):
            stream.log_static(entity, stream.build_frame(WORLD))

    def write(self, block: RowBlock) -> None:
        """Write the release points of every new `TaskPlan` in a block of messages."""
        for row in self._planned_rows(block.messages["id"]):
            plan = block.messages[row]
            moves = plan["moves"][: plan["count"]]
            self._goals |= {
                int(move["id"]): (
                    move["position"].tolist(),
                    f"{format_enum(Verb, move['verb'])} {self._find_object_name(move)}".strip(),
                )
                for move in moves
            }
            ends = [move for move in moves if move["verb"] == Verb.RELEASE]
            points = rr.Points3D(
                [move["position"] for move in ends],
                radii=POINT_M,
                colors=[GOAL],
                labels=[self._find_object_name(move) for move in ends],
                show_labels=False,
            )
            self._stream.log_at(block.find_visible_moment(row), GOALS, points)

    def write_status(self, block: RowBlock) -> None:
        """Write the new goal at each change of the current move in a block of `MoveStatus`."""
        for row in self._current_rows(block.messages["current"]):
            current = int(block.messages["current"][row])
            goals = [self._goals[current]] if current in self._goals else []
            point = rr.Points3D(
                [place for place, _ in goals],
                radii=1.5 * POINT_M,
                colors=[CURRENT],
                labels=[label for _, label in goals],
            )
            self._stream.log_at(block.find_moment(row), CURRENT_GOAL, point)

    def _find_object_name(self, move: np.void) -> str:
        """Return the name of a move's object, or "" if it has none."""
        row = int(move["object"])
        return self._objects[row] if 0 <= row < len(self._objects) else ""
