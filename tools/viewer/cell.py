"""The cell in 3D: its geoms, each once, in the frame of its body; poses of moving bodies; pushes;
path and goals."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rack.levels.messages import SegmentKind, Verb
from rack.levels.robot.cell import STATE, Cell
from rack.tools.viewer.forces import contacts_of
from rack.tools.viewer.levels import verb_name
from rack.tools.viewer.shapes import shape_of, xyzw
from rack.tools.viewer.stream import Changes, RowBlock, Sampled, Stream
from rack.tools.viewer.style import CURRENT, FORCE, GOAL, PLANNED

CELL = "cell"
COLLISION = "collision"
FRAMES = "frames"
WORLD = "world"
SHOWN_GROUPS = 3
"""MuJoCo's own viewer shows groups 0, 1, 2; by convention those above hold collision shapes."""
TOOL = (CELL, "tool")
TOOL_COLOUR = (230, 60, 200)
PATH = (CELL, "planned_path")
WAYPOINTS = (CELL, "way_points")
GOALS = (CELL, "goals")
CURRENT_GOAL = (CELL, "current_goal")
STEP_RAD = 0.03
"""A straight line in joint space is a curve of the tool: it is drawn in pieces of at most this
length."""
POINT_M = 0.008
LINE_M = 0.003
PUSHES = (CELL, "pushes")
PUSH_M = 0.02
PUSH_RADIUS_M = 0.0015
"""Length of the arrow of a push for each N, and its radius."""


def frame_of(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body's frame."""
    return WORLD if body == 0 else f"body/{model.body(body).name or body}"


def moving_bodies(model: mujoco.MjModel) -> NDArray[np.int_]:
    """Return the bodies moved by joints or as mocap bodies, and all attached to them."""
    moves = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):  # parents come first
        own = model.body_jntnum[body] > 0 or model.body_mocapid[body] >= 0
        moves[body] = own or moves[model.body_parentid[body]]
    return np.flatnonzero(moves)


def write_geometry(stream: Stream, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Log all geoms, and the frames that never move with their poses in `data`."""
    stream.static((CELL,), stream.within(WORLD))
    shown = {geom: bool(model.geom_group[geom] < SHOWN_GROUPS) for geom in range(model.ngeom)}
    for geom in shown:
        shape = shape_of(model, geom)
        if shape is not None:
            entity = _entity(model, geom, shown[geom] or not any(shown.values()))
            stream.static(
                entity, shape, stream.within(frame_of(model, int(model.geom_bodyid[geom])))
            )
    for body in set(range(1, model.nbody)) - set(moving_bodies(model).tolist()):
        pose = rr.Transform3D(
            translation=data.xpos[body],
            quaternion=rr.Quaternion(xyzw=xyzw(data.xquat[body])),
            parent_frame=stream.frame(WORLD),
            child_frame=stream.frame(frame_of(model, body)),
        )
        stream.static((FRAMES, frame_of(model, body)), pose)


def _entity(model: mujoco.MjModel, geom: int, shown: bool) -> tuple[str, ...]:
    body = model.body(int(model.geom_bodyid[geom])).name or f"body {model.geom_bodyid[geom]}"
    name = model.geom(geom).name or f"geom {geom}"
    return (CELL, *(() if shown else (COLLISION,)), body, name)


class Poses:
    """Writes `ARM_STATE`s as poses of all moving bodies, by MuJoCo's own kinematics, and the path
    of the tool."""

    def __init__(self, stream: Stream, cell: Cell, clock_ns: int) -> None:
        self._stream = stream
        self._cell = cell
        self._data = cell.start()
        self._bodies = moving_bodies(cell.model)
        self._contacts = contacts_of(cell)
        self._world = stream.frame(WORLD)
        self._frames = [stream.frame(frame_of(cell.model, int(body))) for body in self._bodies]
        self._frames += [stream.frame(contact.frame) for contact in self._contacts]
        self._sampled = Sampled(clock_ns)
        stream.static(
            TOOL, rr.Points3D.from_fields(radii=0.003, colors=[TOOL_COLOUR]), stream.within(WORLD)
        )

    def write(self, block: RowBlock) -> None:
        """Write poses, one every 20 ms of simulated time."""
        if not len(self._bodies):
            return
        chosen = self._sampled.rows(block.ticks)
        if len(chosen):
            self._write(block, chosen)

    def _write(self, block: RowBlock, chosen: np.ndarray) -> None:
        model = self._cell.model
        data = self._data
        bodies = self._bodies
        count = len(self._frames)
        positions = np.empty((len(chosen), count, 3))
        quaternions = np.empty((len(chosen), count, 4))
        tool = np.empty((len(chosen), 3))
        for row, state in enumerate(block.messages["state"][chosen]):
            mujoco.mj_setState(model, data, np.ascontiguousarray(state), STATE)
            mujoco.mj_kinematics(model, data)
            positions[row, : len(bodies)] = data.xpos[bodies]
            quaternions[row, : len(bodies)] = data.xquat[bodies]
            for at, contact in enumerate(self._contacts, len(bodies)):
                positions[row, at], quaternions[row, at] = contact.pose(data)
            tool[row] = data.site_xpos[self._cell.tool]
        self._stream.columns(TOOL, block.times_of(chosen), rr.Points3D.columns(positions=tool))
        poses = rr.Transform3D.columns(
            translation=positions.reshape(-1, 3),
            quaternion=xyzw(quaternions).reshape(-1, 4),
            parent_frame=[self._world] * (len(chosen) * count),
            child_frame=self._frames * len(chosen),
        )
        self._stream.columns((FRAMES,), block.times_of(np.repeat(chosen, count)), poses)


class Pushes:
    """Writes the forces that the scene exerts on its objects, as `ARM_STATE`s have them."""

    def __init__(self, stream: Stream, cell: Cell, clock_ns: int) -> None:
        self._stream = stream
        self._cell = cell
        self._data = cell.start()
        self._sampled = Sampled(clock_ns)
        self._is_empty = True
        stream.static(PUSHES, stream.within(WORLD))

    def write(self, block: RowBlock) -> None:
        """Write the newest pushes, one set every 20 ms of simulated time."""
        model = self._cell.model
        data = self._data
        bodies = self._cell.bodies
        for row in self._sampled.rows(block.ticks):
            mujoco.mj_setState(
                model, data, np.ascontiguousarray(block.messages["state"][row]), STATE
            )
            forces = data.xfrc_applied[bodies, :3]
            pushed = forces.any(axis=1)
            if self._is_empty and not pushed.any():
                continue
            self._is_empty = not pushed.any()
            mujoco.mj_kinematics(model, data)
            arrows = rr.Arrows3D(
                origins=data.xipos[bodies][pushed],
                vectors=PUSH_M * forces[pushed],
                radii=PUSH_RADIUS_M,
                colors=[FORCE],
            )
            self._stream.at(*block.when(row), PUSHES, arrows)


class PlannedPath:
    """Writes `MOVE_PLAN`s as a line of the tool point with its way points, from the tick at which
    they are visible."""

    def __init__(self, stream: Stream, cell: Cell) -> None:
        self._stream = stream
        self._cell = cell
        self._data = cell.start()
        for entity in (PATH, WAYPOINTS):
            stream.static(entity, stream.within(WORLD))

    def write(self, block: RowBlock) -> None:
        """Write every plan; a plan for the gripper clears the path."""
        for row in range(len(block.rows)):
            plan = block.messages[row]
            tick = int(block.rows["visible_at"][row])
            moves = plan["kind"] == SegmentKind.PATH and not plan["error"]
            corners = (
                plan["waypoints"][: plan["count"]] if moves else np.empty((0, len(self._cell.qpos)))
            )
            line = [self._tool(joints) for joints in in_pieces(corners)]
            points = [self._tool(joints) for joints in corners]
            stamp_ns = int(block.stamps_ns[row])
            strips = rr.LineStrips3D([line] if line else [], radii=LINE_M, colors=[PLANNED])
            self._stream.at(tick, stamp_ns, PATH, strips)
            self._stream.at(
                tick, stamp_ns, WAYPOINTS, rr.Points3D(points, radii=POINT_M, colors=[PLANNED])
            )

    def _tool(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the position of the tool at joint positions, (3,), m."""
        self._data.qpos[self._cell.qpos] = joints
        mujoco.mj_kinematics(self._cell.model, self._data)
        return np.array(self._data.site_xpos[self._cell.tool])


def in_pieces(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points of a joint path, (points, joints), with no piece longer than `STEP_RAD`."""
    if len(corners) < 2:
        return corners
    counts = [
        max(1, int(np.ceil(np.abs(step).max() / STEP_RAD))) for step in np.diff(corners, axis=0)
    ]
    pieces = [
        np.linspace(a, b, n, endpoint=False)
        for a, b, n in zip(corners, corners[1:], counts, strict=False)
    ]
    return np.concatenate((*pieces, corners[-1:]))


class Goals:
    """Writes the places where a `TASK_PLAN` puts its objects down, and the goal of the current
    move."""

    def __init__(self, stream: Stream, objects: Sequence[str]) -> None:
        self._stream = stream
        self._objects = objects
        self._moves: dict[int, tuple[list[float], str]] = {}
        self._plans = Changes()
        self._current = Changes()
        for entity in (GOALS, CURRENT_GOAL):
            stream.static(entity, stream.within(WORLD))

    def write(self, block: RowBlock) -> None:
        """Write the goals of every new plan."""
        for row in self._plans.rows(block.messages["id"]):
            plan = block.messages[row]
            moves = plan["moves"][: plan["count"]]
            self._moves |= {
                int(move["id"]): (move["position"].tolist(), self._name(move)) for move in moves
            }
            ends = [move for move in moves if move["verb"] == Verb.RELEASE]
            points = rr.Points3D(
                [move["position"] for move in ends],
                radii=POINT_M,
                colors=[GOAL],
                labels=[self._object(move) for move in ends],
                show_labels=False,
            )
            self._stream.at(
                int(block.rows["visible_at"][row]), int(block.stamps_ns[row]), GOALS, points
            )

    def write_status(self, block: RowBlock) -> None:
        """Write the goal of the move that each `MOVE_STATUS` names."""
        for row in self._current.rows(block.messages["current"]):
            move = self._moves.get(int(block.messages["current"][row]))
            positions, labels = ([move[0]], [move[1]]) if move else ([], [])
            point = rr.Points3D(positions, radii=1.5 * POINT_M, colors=[CURRENT], labels=labels)
            self._stream.at(*block.when(row), CURRENT_GOAL, point)

    def _name(self, move: np.void) -> str:
        return f"{verb_name(int(move['verb']))} {self._object(move)}".strip()

    def _object(self, move: np.void) -> str:
        row = int(move["object"])
        return self._objects[row] if 0 <= row < len(self._objects) else ""
