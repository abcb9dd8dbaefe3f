"""The path of one elemental move: inverse kinematics, then a straight line or a search.

The tool follows the straight line; the search is in joint space.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from rack.levels import compiled
from rack.levels.algebra import Array, mat_vec, norm
from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.motion import path as paths
from rack.levels.motion.path import BlendedPath, Path
from rack.levels.planning import collision, path_planner
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.ik import SAME_RAD, InverseKinematics
from rack.levels.planning.moves import VERB_NAMES, Move, Situation
from rack.levels.planning.path_planner import MAX_SEARCHES, FirstBlocked, PathPlanner
from rack.levels.planning.payload import Payloads, find_fixed_jaw
from rack.levels.planning.pose import Pose
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

REMAINING_CLEARANCE_PART = 0.9
"""Part of the remaining clearance that a path keeps if the arm starts too close to something."""
LOAD_STEP_RAD = 0.25
"""Spacing of the configurations at which the motors must carry the load."""
REUSE_CLEARANCE_PART = 0.5
"""Part of the clearance that an earlier path must keep, because sensed and predicted poses differ
slightly."""
MAX_DEVIATION_M = 1e-3
"""Largest deviation of the tool from a straight line that it follows."""
LINES = (1, 2, 3, 4, 6, 8, 12, 16, 20)
"""Numbers of joint-space lines that are tried for a straight line of the tool. The fewest that keep
to it give the quickest path."""
DEVIATION_SAMPLES = 5
"""Number of points on every joint-space line at which the deviation of the tool is measured."""


def preload() -> None:
    """Load the modules and compiled functions that motion planning needs."""
    import numpy.random  # noqa: F401  # numpy loads it at its first use

    compiled.preload(collision, paths, path_planner)


class MotionPlanner:
    """Plans elemental moves for one arm. Equal arguments give equal paths in every process."""

    def __init__(self, cell: Cell, scene: SceneConfig, seed: int) -> None:
        self.cell = cell
        self.clearance = scene.clearance  # m
        self.ik = InverseKinematics(cell, seed)
        self.checker = CollisionChecker(cell, scene, MAX_DEVIATION_M)
        self.paths = PathPlanner(cell, scene.clearance, seed)
        self.payloads = Payloads(cell, scene.objects)
        self.fixed_jaw = find_fixed_jaw(cell, self.payloads)

    def plan(
        self,
        move: Move,
        start: Array,
        situation: Situation,
        *,
        attempt: int = 0,
        goal: Array | None = None,
        searches: int = MAX_SEARCHES,
    ) -> Path:
        """Return the path of one move.

        Args:
            move: Move to plan.
            start: Configuration at the start, (joints,), rad.
            situation: Poses of bodies and the held object.
            attempt: Number of earlier tries in the same situation, which changes the random search.
            goal: Required configuration at the end, (joints,), rad. Paths already planned from
                there remain valid. None lets the planner choose the end.
            searches: See `PathPlanner.plan`.

        Raises:
            Refused: UNREACHABLE if no configuration reaches the goal, NO_PATH if the goal or every
                path is blocked, OVERLOAD if the motors cannot carry the load along the path.
        """
        self.set_situation(move, situation)
        if move.can_touch:
            path = self._plan_line(move, start, goal)
        else:
            goal = self.find_goal(move, start) if goal is None else goal
            clearance = self._find_clearance(start)
            first_blocked = self._bind_clearance(clearance)
            free_path = self.paths.plan(
                start, goal, first_blocked, attempt=attempt, searches=searches
            )
            if free_path is None:
                place = format_position(self.ik.compute_tool_pose(goal))
                reason = self._explain_failure(start, goal, clearance)
                raise Refused(Error.NO_PATH, f"{VERB_NAMES[move.verb]} to {place}: {reason}")
            path = free_path
        if situation.held is not None and situation.grip is not None:
            along = BlendedPath(*path).sample_points(LOAD_STEP_RAD)
            self.payloads.check_motors(situation.held, situation.grip, along)
        return path

    def set_situation(self, move: Move, situation: Situation) -> None:
        """Set the collision checker to `situation`, and permit the contacts that `move` intends."""
        situation.apply_to(self.checker, move.object if move.can_touch else None)

    def find_goal(self, move: Move, start: Array) -> Array:
        """Return the configuration at the end of a free motion, in the situation set last.

        Raises:
            Refused: No configuration reaches the goal, or all that reach it are blocked.
        """
        if move.verb is Verb.MOVE_JOINTS:
            low, high = self.cell.limits.position.T
            beyond = np.flatnonzero((move.joints < low) | (move.joints > high))
            if beyond.size:
                j = int(beyond[0])
                raise Refused(
                    Error.UNREACHABLE,
                    f"joint '{self.cell.joints[j]}' to {move.joints[j]:.4g} rad; valid:"
                    f" {low[j]:.4g} to {high[j]:.4g}",
                )
            return move.joints
        if move.posture:
            nearest = self.ik.find_nearby(move.tool, move.joints)
            if nearest is not None and self.checker.is_free(nearest):
                return nearest
        reference = move.joints if move.posture else start
        reachable = self.ik.find_solutions(move.tool, reference)
        name = VERB_NAMES[move.verb]
        place = format_position(move.tool)
        if not reachable:
            raise Refused(Error.UNREACHABLE, f"{name}: the arm cannot bring the tool to {place}")
        for q in reachable:
            if self.checker.is_free(q):
                return q
        raise Refused(
            Error.NO_PATH, f"{name} to {place}: {self.checker.describe_collision(reachable[0])}"
        )

    def is_still_free(self, move: Move, path: Path, situation: Situation) -> bool:
        """Return True if an earlier path of `move` is still free of collisions in `situation`."""
        self.set_situation(move, situation)
        first_blocked = self._bind_clearance(REUSE_CLEARANCE_PART * self.clearance)
        return self.paths.find_blocked_configuration(path, first_blocked) is None

    def _bind_clearance(self, clearance: float) -> FirstBlocked:
        """Return a collision check for paths that requires a clearance, in m."""
        return partial(self.checker.find_first_blocked, clearance=clearance)

    def _explain_failure(self, start: Array, goal: Array, clearance: float) -> str:
        """Explain why a free motion has no path.

        The reason is a blocked start or goal, or the obstacle on the straight line between them.
        """
        for q in (start, goal):
            if text := self.checker.describe_collision(q, clearance):
                return text
        straight = Path(np.array([start, goal]), np.zeros(2))
        blocked = self.paths.find_blocked_configuration(straight, self._bind_clearance(clearance))
        if blocked is None:
            return "no path found"
        return f"no path found around {self.checker.describe_collision(blocked, clearance)}"

    def _plan_line(self, move: Move, start: Array, goal: Array | None) -> Path:
        """Plan a straight line of the tool. See `plan` for the arguments.

        Raises:
            Refused: The line leaves the reach of the arm, or is blocked.
        """
        name = VERB_NAMES[move.verb]
        place = format_position(move.tool)
        path = plan_straight_line(self.ik, start, move.tool)
        if path is None:
            raise Refused(Error.UNREACHABLE, f"{name}: no straight tool line to {place}")
        if goal is not None and np.max(np.abs(path.end - goal)) < SAME_RAD:
            path.waypoints[-1] = goal
        clearance = self._find_clearance(start)
        blocked = self.paths.find_blocked_configuration(path, self._bind_clearance(clearance))
        if blocked is not None:
            raise Refused(
                Error.NO_PATH,
                f"{name} to {place}: {self.checker.describe_collision(blocked, clearance)}",
            )
        return path

    def _find_clearance(self, start: Array) -> float:
        """Return the clearance that a path from `start` must keep, in m.

        It is the scene's clearance, or less if the arm is already closer to an obstacle.
        """
        available = self.checker.find_clearance(start)
        return (
            self.clearance
            if available >= self.clearance
            else max(REMAINING_CLEARANCE_PART * available, 0.0)
        )


def plan_straight_line(ik: InverseKinematics, start: Array, target: Pose) -> Path | None:
    """Return a path along which the tool moves straight to a target, or None.

    The tool turns at a constant rate and deviates at most `MAX_DEVIATION_M`. There is no such path
    if the line leaves the reach of the arm, or continues only on another branch of the inverse
    kinematics. Collisions are not checked.

    Args:
        ik: Inverse kinematics of the arm.
        start: Configuration at the start, (joints,), rad.
        target: Pose of the tool at the end.
    """
    begin = ik.compute_tool_pose(start)
    for lines in LINES:
        points = [start]
        for k in range(1, lines + 1):
            q = ik.find_nearby(begin.interpolate_to(target, k / lines), points[-1])
            if q is None:
                break
            points.append(q)
        else:
            # Blends take half of the shorter adjacent line, so the motion never stops.
            lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
            blend = np.zeros(len(points))
            blend[1:-1] = 0.5 * np.minimum(lengths[:-1], lengths[1:])
            path = Path(np.array(points), blend)
            if _compute_deviation(ik, path, begin, target) < MAX_DEVIATION_M:
                return path
    return None


def _compute_deviation(ik: InverseKinematics, path: Path, begin: Pose, target: Pose) -> float:
    """Return the largest distance of the tool from the straight line, in m."""
    blended = BlendedPath(*path)
    if blended.length == 0.0:
        return 0.0
    line = target.position - begin.position
    length = norm(line)
    samples = blended.sample_points(
        blended.length / (DEVIATION_SAMPLES * (len(path.waypoints) - 1))
    )
    deviations = np.array([ik.compute_tool_pose(q).position - begin.position for q in samples])
    if length > 0.0:
        deviations -= np.outer(mat_vec(deviations, line) / length**2, line)
    return float(np.max(np.linalg.norm(deviations, axis=1)))


def format_position(tool: Pose) -> str:
    """Return the position of a tool, in m, as text."""
    return "[{:.3f}, {:.3f}, {:.3f}]".format(*tool.position)
