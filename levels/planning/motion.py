"""The path of one elemental move: inverse kinematics, then a straight tool line or a search in joint space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import SAME_RAD, InverseKinematics
from rack.levels.planning.line import straight_line
from rack.levels.planning.move import NAMES, Move
from rack.levels.planning.path import Path
from rack.levels.planning.path_planner import SEARCHES, PathPlanner
from rack.levels.planning.payload import Payloads
from rack.levels.planning.pose import Pose
from rack.levels.planning.situation import Situation
from rack.levels.primitive.path import BlendedPath
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

Array = NDArray[np.float64]

CLOSE_PART = 0.9
"""Of the room that is left where the arm rests too close to something: the clearance of the way out."""
LOAD_STEP_RAD = 0.25
"""Spacing of the configurations at which the motors must carry what is held."""
AHEAD_PART = 0.5
"""Part of the clearance that a path planned before must still have: sensed and predicted poses differ a little."""


class MotionPlanner:
    """Plans elemental moves for one arm. Pure: equal arguments give equal paths, in every process."""

    def __init__(self, cell: Cell, scene: SceneConfig, seed: int) -> None:
        self.cell = cell
        self.clearance = scene.clearance
        self.ik = InverseKinematics(cell, seed)
        self.checker = CollisionChecker(cell, scene)
        self.paths = PathPlanner(cell, scene.clearance, seed)
        self.payloads = Payloads(cell, scene.objects)

    def plan(
        self,
        move: Move,
        start: Array,
        situation: Situation,
        attempt: int = 0,
        goal: Array | None = None,
        searches: int = SEARCHES,
    ) -> Path:
        """Return the path of `move` from `start` (joints,), rad.

        `attempt` counts tries in the same situation. With `goal` (joints,) the path ends there, so that paths planned
        from there stay good. `searches` as in `PathPlanner.plan`. Raises `Refused`: UNREACHABLE when no configuration
        serves, NO_PATH when all are blocked, OVERLOAD when the motors cannot carry along it what is held.
        """
        self.lay_out(move, situation)
        if move.touches:
            path = self._line(move, start, goal)
        else:
            path = self._path_to(move, start, self.goal(move, start) if goal is None else goal, attempt, searches)
        if situation.held is not None and situation.grip is not None:
            along = BlendedPath(*path).sample(LOAD_STEP_RAD)
            self.payloads.check_motors(situation.held, situation.grip, along)
        return path

    def lay_out(self, move: Move, situation: Situation) -> None:
        """Set the collision checker to `situation` with the contacts that `move` means."""
        situation.lay_out(self.checker, move.object if move.touches else None)

    def goal(self, move: Move, start: Array) -> Array:
        """Return the configuration at the end of a free motion, as the checker is set. Raises `Refused`."""
        if move.verb is Verb.MOVE_JOINTS:
            self._check_limits(move)
            return move.joints
        if move.posture:
            near = self.ik.nearby(move.tool, move.joints)
            if near is not None and self.checker.free(near):
                return near
        reference = move.joints if move.posture else start
        reachable = self.ik.reachable(move.tool, reference)
        if not reachable:
            raise Refused(Error.UNREACHABLE, f"{NAMES[move.verb]}: the arm cannot bring the tool to {at(move.tool)}")
        for q in reachable:
            if self.checker.free(q):
                return q
        why = self.checker.why(reachable[0])
        raise Refused(Error.NO_PATH, f"{NAMES[move.verb]} to {at(move.tool)}: {why}")

    def _path_to(self, move: Move, start: Array, goal: Array, attempt: int, searches: int) -> Path:
        clearance = self._clearance_at(start)
        path = self.paths.plan(start, goal, lambda q: self.checker.free(q, clearance), attempt, searches)
        if path is None:
            why = self.checker.why(start, clearance) or self.checker.why(goal, clearance)
            if not why:
                straight = Path(np.array([start, goal]), np.zeros(2))
                blocked = self.paths.first_blocked(straight, lambda q: self.checker.free(q, clearance))
                found = self.checker.why(blocked, clearance) if blocked is not None else ""
                why = f"no path found around {found}" if found else "no path found"
            raise Refused(Error.NO_PATH, f"{NAMES[move.verb]} to {at(self.ik.tool_at(goal))}: {why}")
        return path

    def still_free(self, move: Move, path: Path, situation: Situation) -> bool:
        """Say whether a path planned before can still be gone in `situation`."""
        self.lay_out(move, situation)
        clearance = AHEAD_PART * self.clearance
        return self.paths.is_free(path, lambda q: self.checker.free(q, clearance))

    def _line(self, move: Move, start: Array, goal: Array | None) -> Path:
        path = straight_line(self.ik, start, move.tool)
        if path is not None and goal is not None and np.max(np.abs(path.end - goal)) < SAME_RAD:
            path.waypoints[-1] = goal
        if path is None:
            raise Refused(Error.UNREACHABLE, f"{NAMES[move.verb]}: no straight tool line to {at(move.tool)}")
        clearance = self._clearance_at(start)
        blocked = self.paths.first_blocked(path, lambda q: self.checker.free(q, clearance))
        if blocked is not None:
            why = self.checker.why(blocked, clearance)
            raise Refused(Error.NO_PATH, f"{NAMES[move.verb]} to {at(move.tool)}: {why}")
        return path

    def _clearance_at(self, start: Array) -> float:
        """Return the scene's clearance, or less where an obstacle has come closer to the resting arm."""
        room = self.checker.room(start)
        return self.clearance if room >= self.clearance else max(CLOSE_PART * room, 0.0)

    def _check_limits(self, move: Move) -> None:
        low, high = self.cell.limits.position.T
        beyond = np.flatnonzero((move.joints < low) | (move.joints > high))
        if beyond.size:
            j = int(beyond[0])
            name = self.cell.model.joint(self.cell.model.dof_jntid[self.cell.dof[j]]).name
            raise Refused(
                Error.UNREACHABLE, f"joint '{name}' to {move.joints[j]:.4g} rad; valid: {low[j]:.4g} to {high[j]:.4g}"
            )


def at(tool: Pose) -> str:
    """Return a position as a user writes it, in m."""
    return "[{:.3f}, {:.3f}, {:.3f}]".format(*tool.position)
