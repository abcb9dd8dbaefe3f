"""Collision-free paths between two configurations: straight where that is free, else sampled, with
rounded corners.

The search is OMPL's RRTConnect, then short cuts. It ends by the number of configurations checked,
never by time, and every call seeds the random numbers anew: equal arguments give equal paths, in
every process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from ompl import base, geometric, util

from rack.levels.algebra import Array, norm
from rack.levels.messages import WAYPOINTS
from rack.levels.motion.path import BlendedPath, Path
from rack.levels.motion.trajectory import make_trajectory
from rack.levels.planning.ik import sampling_range
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import below, geoms_of

Free = Callable[[Array], bool]

MAX_CHECKS = 24_000
"""Configurations checked by all searches of a plan together: this bounds its time."""
MAX_SEARCHES = 6
"""Searches of one plan, each with its own seed; the quickest path found is taken."""
MAX_SEED = 2**31 - 1
STEP_PART = 0.5
"""No point of the arm moves farther between two checks than this part of the clearance."""
MIN_LEVER_M = 0.05
"""Least weight of a joint in the metric, for joints that hardly move any geom."""
LEVER_SAMPLES = 64
"""Random configurations over which the longest lever is taken."""
BLENDS = (1.0, 0.6, 0.35, 0.2, 0.1)
"""Parts of the largest blend that are tried at a corner; when all collide, the motion stops
there."""
END_PART = 0.9
"""Part of the first and the last line that a blend may take."""
BRANCH_PART = 0.2
"""Longest branch of the tree, as a part of the space's extent."""
ENDLESS_RAD = 2.0 * np.pi
"""Range beyond start and goal of a joint without limits."""
BOUND_ROUNDING = 1e-9
"""Margin of the space's bounds, in scaled length, so that start and goal are inside in spite of
rounding."""

util.setLogLevel(util.LOG_NONE)


class PathPlanner:
    """Plans paths for one arm. Pure: equal arguments give equal paths."""

    def __init__(self, cell: Cell, clearance: float, seed: int) -> None:
        self._limits = cell.limits
        self._seed = seed
        levers = np.maximum(lever_arms(cell, seed), MIN_LEVER_M)
        # sum |lever_j dq_j| <= |lever| |dq|: a step of this length moves no point farther than
        # intended.
        self.step_rad = STEP_PART * clearance / norm(levers)
        low, high = cell.limits.position.T
        resolution = STEP_PART * clearance / float(np.sqrt(len(levers)))
        self._search = SampledSearch(low, high, levers, resolution)

    def plan(
        self,
        start: Array,
        goal: Array,
        free: Free,
        *,
        attempt: int = 0,
        searches: int = MAX_SEARCHES,
    ) -> Path | None:
        """Return the quickest path found from `start` to `goal` (joints,), rad, or None.

        Another `attempt` uses other random numbers, for another try in the same world. With fewer
        `searches` the path is found sooner and is never quicker than with more.
        """
        if not (free(start) and free(goal)):
            return None
        if self._line_is_free(start, goal, free):
            return Path(np.array([start, goal]), np.zeros(2))
        paths = self._sampled(Query(start, goal, free), attempt, searches)
        return min(paths, key=self.duration, default=None)

    def rounded(self, waypoints: Array, free: Free) -> Path:
        """Return the path along `waypoints`, with each corner rounded as far as it stays free."""
        blend = _largest_blends(waypoints)
        for corner in range(1, len(waypoints) - 1):
            blend[corner] = self._free_blend(waypoints, corner, float(blend[corner]), free)
        return Path(waypoints, blend)

    def is_free(self, path: Path, free: Free) -> bool:
        """Return whether all of `path` is free."""
        return self.first_blocked(path, free) is None

    def first_blocked(self, path: Path, free: Free) -> Array | None:
        """Return the first configuration on `path` that is not free; None when all are."""
        return next((q for q in BlendedPath(*path).sample(self.step_rad) if not free(q)), None)

    def duration(self, path: Path) -> float:
        """Return the time of `path`, rest to rest, in s."""
        return make_trajectory(BlendedPath(*path), self._limits).duration

    def _sampled(self, query: Query, attempt: int, searches: int) -> list[Path]:
        paths: list[Path] = []
        left = MAX_CHECKS
        for k in range(MAX_SEARCHES):
            seed = 1 + (self._seed + attempt * MAX_SEARCHES + k) % MAX_SEED
            polyline, checks = self._search.search(query, seed, left)
            left -= checks
            if polyline is not None and len(polyline) <= WAYPOINTS:
                paths.append(self.rounded(polyline, query.free))
            if left <= 0 or len(paths) == searches:
                break
        return paths

    def _line_is_free(self, one: Array, other: Array, free: Free) -> bool:
        count = int(np.ceil(norm(other - one) / self.step_rad)) + 1
        return all(free(q) for q in np.linspace(one, other, max(count, 2)))

    def _free_blend(self, waypoints: Array, corner: int, largest: float, free: Free) -> float:
        before, at, after = waypoints[corner - 1 : corner + 2]
        for part in BLENDS:
            b = part * largest
            ends = [at + b * (end - at) / max(norm(end - at), b) for end in (before, after)]
            if self.is_free(Path(np.array([ends[0], at, ends[1]]), np.array([0.0, b, 0.0])), free):
                return b
        return 0.0


class Query(NamedTuple):
    """Start and goal (joints,), rad, of a search, and whether a configuration is free."""

    start: Array
    goal: Array
    free: Free


class SampledSearch:
    """Searches joint space scaled by `weights` (joints,) for polylines checked every `resolution`
    of scaled length."""

    def __init__(self, low: Array, high: Array, weights: Array, resolution: float) -> None:
        self._low = low
        self._high = high
        self._weights = weights
        self._resolution = resolution

    def search(self, query: Query, seed: int, budget: int) -> tuple[Array | None, int]:
        """Return a free polyline (k, joints), rad, or None, and the number of configurations
        checked.

        `budget` bounds the checks of the search; the short cuts add a few.
        """
        util.RNG.setSeed(seed)
        start, goal, free = query
        count = 0
        scaled = np.zeros(len(start))

        def valid(state: base.State) -> bool:
            nonlocal count
            count += 1
            for j in range(len(scaled)):
                scaled[j] = state[j]
            return free(scaled / self._weights)

        information = self._space(start, goal, valid)
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(
            self._state(information, start), self._state(information, goal)
        )
        planner = geometric.RRTConnect(information)
        planner.setRange(BRANCH_PART * information.getMaximumExtent())
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(base.PlannerTerminationCondition(lambda: count > budget))
        if not problem.hasExactSolution():
            return None, count
        path = _simplified(information, problem.getSolutionPath())
        points = [[state[j] for j in range(len(start))] for state in path.getStates()]
        polyline = np.array(points) / self._weights
        # Scaling there and back rounds: restore the exact ends.
        polyline[0] = start
        polyline[-1] = goal
        return polyline, count

    def _space(
        self, start: Array, goal: Array, valid: Callable[[base.State], bool]
    ) -> base.SpaceInformation:
        joints = len(start)
        low = np.where(np.isfinite(self._low), self._low, np.minimum(start, goal) - ENDLESS_RAD)
        high = np.where(np.isfinite(self._high), self._high, np.maximum(start, goal) + ENDLESS_RAD)
        space = base.RealVectorStateSpace(joints)
        bounds = base.RealVectorBounds(joints)
        for j in range(joints):
            # The arm may rest slightly beyond a limit: the start counts as inside.
            bounds.setLow(
                j, float(min(low[j], start[j], goal[j]) * self._weights[j]) - BOUND_ROUNDING
            )
            bounds.setHigh(
                j, float(max(high[j], start[j], goal[j]) * self._weights[j]) + BOUND_ROUNDING
            )
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(valid)
        information.setStateValidityCheckingResolution(self._resolution / space.getMaximumExtent())
        information.setup()
        return information

    def _state(self, information: base.SpaceInformation, q: Array) -> base.State:
        state = information.allocState()
        for j, value in enumerate(q * self._weights):
            state[j] = float(value)
        return state


def _simplified(
    information: base.SpaceInformation, path: geometric.PathGeometric
) -> geometric.PathGeometric:
    simplifier = geometric.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.collapseCloseVertices(path)
    simplifier.reduceVertices(path)
    return path


def _largest_blends(waypoints: Array) -> Array:
    """Return blends (k,) that do not overlap: up to half of an inner line, most of the first and
    the last."""
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    room = 0.5 * lengths
    room[[0, -1]] = END_PART * lengths[[0, -1]] if len(lengths) > 1 else 0.0
    blend = np.zeros(len(waypoints))
    blend[1:-1] = np.minimum(room[:-1], room[1:])
    return blend


def lever_arms(cell: Cell, seed: int) -> Array:
    """Return (joints,): the farthest that 1 rad (or 1 m) of each joint moves any geom that it
    carries, in m.

    A joint step dq moves no point of the arm by more than sum |lever_j dq_j|.
    """
    data = mujoco.MjData(cell.model)
    rng = np.random.default_rng(seed)
    levers = np.zeros(len(cell.qpos))
    low, high = sampling_range(cell)
    for _ in range(LEVER_SAMPLES):
        data.qpos[cell.qpos] = rng.uniform(low, high)
        mujoco.mj_kinematics(cell.model, data)
        np.maximum(levers, [_lever(cell, data, j) for j in range(len(levers))], out=levers)
    return levers


def _lever(cell: Cell, data: mujoco.MjData, joint: int) -> float:
    m = cell.model
    dof = cell.dof[joint]
    index = int(m.dof_jntid[dof])
    if m.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE:
        return 1.0
    carried = geoms_of(m, below(m, m.jnt_bodyid[[index]]))
    moved = np.intersect1d(carried, cell.arm_geoms)
    if not moved.size:
        return 0.0
    from_axis = np.cross(data.geom_xpos[moved] - data.xanchor[index], data.xaxis[index])
    return float(np.max(np.linalg.norm(from_axis, axis=1) + m.geom_rbound[moved]))
