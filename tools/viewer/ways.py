"""Where the arm is to go: the planned path as a line of the tool point, its way points, and the goals."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rack.levels.messages import SegmentKind, Verb
from rack.levels.robot.cell import Cell
from rack.tools.viewer.blocks import Block, Changes
from rack.tools.viewer.geometry import CELL, WORLD
from rack.tools.viewer.palette import CURRENT, GOAL, PLANNED
from rack.tools.viewer.stream import Stream

PATH, WAYPOINTS = (CELL, "planned_path"), (CELL, "way_points")
GOALS, CURRENT_GOAL = (CELL, "goals"), (CELL, "current_goal")
STEP_RAD = 0.03
"""A straight line of the joints is a curve of the tool: drawn in pieces of at most that."""
POINT_M, LINE_M = 0.008, 0.003


class PlannedPath:
    """Writes `MOVE_PLAN`s, from the tick at which they can be used."""

    def __init__(self, stream: Stream, cell: Cell) -> None:
        self._stream, self._cell, self._data = stream, cell, cell.start()
        for entity in (PATH, WAYPOINTS):
            stream.static(entity, rr.CoordinateFrame(WORLD))

    def write(self, block: Block) -> None:
        """Write every plan; one for the gripper clears the path."""
        for row in range(len(block.rows)):
            plan, tick = block.messages[row], int(block.rows["visible_at"][row])
            moves = plan["kind"] == SegmentKind.PATH and not plan["error"]
            corners = plan["waypoints"][: plan["count"]] if moves else np.empty((0, len(self._cell.qpos)))
            line = [self._tool(joints) for joints in in_pieces(corners)]
            points = [self._tool(joints) for joints in corners]
            stamp_ns = int(block.stamps_ns[row])
            strips = rr.LineStrips3D([line] if line else [], radii=LINE_M, colors=[PLANNED])
            self._stream.at(tick, stamp_ns, PATH, strips)
            self._stream.at(tick, stamp_ns, WAYPOINTS, rr.Points3D(points, radii=POINT_M, colors=[PLANNED]))

    def _tool(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the position of the tool at joint positions, (3,), m."""
        self._data.qpos[self._cell.qpos] = joints
        mujoco.mj_kinematics(self._cell.model, self._data)
        return np.array(self._data.site_xpos[self._cell.tool])


def in_pieces(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points of a joint path, (points, joints), with no piece longer than `STEP_RAD`."""
    if len(corners) < 2:
        return corners
    counts = [max(1, int(np.ceil(np.abs(step).max() / STEP_RAD))) for step in np.diff(corners, axis=0)]
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(corners, corners[1:], counts, strict=False)]
    return np.concatenate((*pieces, corners[-1:]))


class Goals:
    """Writes where a `TASK_PLAN` puts its objects down, and the end of the move under way."""

    def __init__(self, stream: Stream, objects: Sequence[str]) -> None:
        self._stream, self._objects = stream, objects
        self._moves: dict[int, tuple[list[float], str]] = {}
        self._plans, self._current = Changes(), Changes()
        for entity in (GOALS, CURRENT_GOAL):
            stream.static(entity, rr.CoordinateFrame(WORLD))

    def write(self, block: Block) -> None:
        """Write the goals of every new plan."""
        for row in self._plans.rows(block.messages["id"]):
            plan = block.messages[row]
            moves = plan["moves"][: plan["count"]]
            self._moves |= {int(move["id"]): (move["position"].tolist(), self._name(move)) for move in moves}
            ends = [move for move in moves if move["verb"] == Verb.RELEASE]
            points = rr.Points3D(
                [move["position"] for move in ends],
                radii=POINT_M,
                colors=[GOAL],
                labels=[self._object(move) for move in ends],
                show_labels=False,
            )
            self._stream.at(int(block.rows["visible_at"][row]), int(block.stamps_ns[row]), GOALS, points)

    def write_status(self, block: Block) -> None:
        """Write the goal of the move that each `MOVE_STATUS` names."""
        for row in self._current.rows(block.messages["current"]):
            move = self._moves.get(int(block.messages["current"][row]))
            positions, labels = ([move[0]], [move[1]]) if move else ([], [])
            point = rr.Points3D(positions, radii=1.5 * POINT_M, colors=[CURRENT], labels=labels)
            self._stream.at(int(block.ticks[row]), int(block.stamps_ns[row]), CURRENT_GOAL, point)

    def _name(self, move: np.void) -> str:
        verb = Verb(int(move["verb"])).name.lower().replace("_", " ")
        return f"{verb} {self._object(move)}".strip()

    def _object(self, move: np.void) -> str:
        row = int(move["object"])
        return self._objects[row] if 0 <= row < len(self._objects) else ""


class CurrentGoal:
    """The side of `Goals` that reads statuses."""

    def __init__(self, goals: Goals) -> None:
        self.write = goals.write_status
