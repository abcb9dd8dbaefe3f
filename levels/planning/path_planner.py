"""Collision-free paths between two configurations: straight where that is free, else sampled, with
rounded corners.

The search is OMPL's RRTConnect, then short cuts. It ends by the number of configurations checked,
never by time, and every call seeds the random numbers anew: equal arguments give equal paths, in
every process.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from ompl import base, geometric, util

from rack.levels.algebra import Array, norm
from rack.levels.compiled import compiled_for
from rack.levels.messages import WAYPOINTS
from rack.levels.motion.path import BlendedPath, Path
from rack.levels.motion.trajectory import make_trajectory
from rack.levels.planning.ik import sampling_range
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import below, geoms_of

Free = Callable[[Array], bool]
"""Returns whether all of some configurations (n, joints) are free."""
FirstBlocked = Callable[[Array], int]
"""Returns the index of the first of configurations (n, joints), rad, that is not free; n: all
are."""

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
        self._levers = np.maximum(lever_arms(cell, seed), MIN_LEVER_M)
        # sum |lever_j dq_j| <= |lever| |dq|: a step of this length moves no point farther than
        # intended.
        self.step_rad = STEP_PART * clearance / norm(self._levers)
        # Of scaled length between two checks.
        self._resolution = STEP_PART * clearance / float(np.sqrt(len(self._levers)))

    def plan(
        self,
        start: Array,
        goal: Array,
        first_blocked: FirstBlocked,
        *,
        attempt: int = 0,
        searches: int = MAX_SEARCHES,
    ) -> Path | None:
        """Return the quickest path found from `start` to `goal` (joints,), rad, or None.

        Another `attempt` uses other random numbers, for another try in the same world. With fewer
        `searches` the path is found sooner and is never quicker than with more.
        """
        ends = np.array([start, goal])
        if first_blocked(ends) < len(ends):
            return None
        count = int(np.ceil(norm(goal - start) / self.step_rad)) + 1
        line = np.linspace(start, goal, max(count, 2))
        if first_blocked(line) == len(line):
            return Path(ends, np.zeros(2))
        paths = self._sampled(ends, first_blocked, attempt, searches)
        if len(paths) == 1:
            return paths[0]
        return min(paths, key=self.duration, default=None)

    def rounded(self, waypoints: Array, first_blocked: FirstBlocked) -> Path:
        """Return the path along `waypoints`, with each corner rounded as far as it stays free."""
        # Blends must not overlap: up to half of an inner line, most of the first and the last.
        lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        room = 0.5 * lengths
        room[[0, -1]] = END_PART * lengths[[0, -1]] if len(lengths) > 1 else 0.0
        blend = np.zeros(len(waypoints))
        blend[1:-1] = np.minimum(room[:-1], room[1:])
        for corner in range(1, len(waypoints) - 1):
            largest = float(blend[corner])
            blend[corner] = self._free_blend(waypoints, corner, largest, first_blocked)
        return Path(waypoints, blend)

    def blocked_at(self, path: Path, first_blocked: FirstBlocked) -> Array | None:
        """Return the first configuration on `path` that is not free; None when all are."""
        samples = BlendedPath(*path).sample(self.step_rad)
        found = first_blocked(samples)
        return samples[found] if found < len(samples) else None

    def duration(self, path: Path) -> float:
        """Return the time of `path`, rest to rest, in s."""
        return make_trajectory(BlendedPath(*path), self._limits).duration

    def _sampled(
        self, ends: Array, first_blocked: FirstBlocked, attempt: int, searches: int
    ) -> list[Path]:
        paths: list[Path] = []
        left = MAX_CHECKS
        for k in range(MAX_SEARCHES):
            seed = 1 + (self._seed + attempt * MAX_SEARCHES + k) % MAX_SEED
            polyline, checks = self._search(ends, first_blocked, seed, left)
            left -= checks
            if polyline is not None and len(polyline) <= WAYPOINTS:
                paths.append(self.rounded(polyline, first_blocked))
            if left <= 0 or len(paths) == searches:
                break
        return paths

    def _free_blend(
        self, waypoints: Array, corner: int, largest: float, first_blocked: FirstBlocked
    ) -> float:
        before, at, after = waypoints[corner - 1 : corner + 2]
        for part in BLENDS:
            b = part * largest
            ends = [at + b * (end - at) / max(norm(end - at), b) for end in (before, after)]
            path = Path(np.array([ends[0], at, ends[1]]), np.array([0.0, b, 0.0]))
            if self.blocked_at(path, first_blocked) is None:
                return b
        return 0.0

    def _search(
        self, ends: Array, first_blocked: FirstBlocked, seed: int, budget: int
    ) -> tuple[Array | None, int]:
        """Search joint space, scaled by the levers, between `ends` (2, joints), rad; return a free
        polyline (k, joints), or None, and the number of configurations checked.

        `budget` bounds the checks of the search; the short cuts add a few.
        """
        util.RNG.setSeed(seed)
        count = 0

        def free(scaled: Array) -> bool:
            nonlocal count
            found = first_blocked(scaled / self._levers)
            count += min(found + 1, len(scaled))
            return found == len(scaled)

        information = self._space(ends, free)
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(*(self._state(information, end) for end in ends))
        planner = geometric.RRTConnect(information)
        planner.setRange(BRANCH_PART * information.getMaximumExtent())
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(base.PlannerTerminationCondition(lambda: count > budget))
        if not problem.hasExactSolution():
            return None, count
        path = problem.getSolutionPath()
        simplifier = geometric.PathSimplifier(information)
        simplifier.reduceVertices(path)
        simplifier.partialShortcutPath(path)
        simplifier.collapseCloseVertices(path)
        simplifier.reduceVertices(path)
        polyline = self._values(*path.getStates()) / self._levers
        # Scaling there and back rounds: restore the exact ends.
        polyline[[0, -1]] = ends
        return polyline, count

    def _space(self, ends: Array, free: Free) -> base.SpaceInformation:
        least = ends.min(axis=0)
        most = ends.max(axis=0)
        low, high = self._limits.position.T
        low = np.where(np.isfinite(low), low, least - ENDLESS_RAD)
        high = np.where(np.isfinite(high), high, most + ENDLESS_RAD)
        space = base.RealVectorStateSpace(len(least))
        bounds = base.RealVectorBounds(len(least))
        # The arm may rest slightly beyond a limit: the start counts as inside.
        for j, value in enumerate(np.minimum(low, least) * self._levers - BOUND_ROUNDING):
            bounds.setLow(j, value)
        for j, value in enumerate(np.maximum(high, most) * self._levers + BOUND_ROUNDING):
            bounds.setHigh(j, value)
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(lambda state: free(self._values(state)))
        information.setMotionValidator(MotionCheck(information, self._values, free))
        information.setStateValidityCheckingResolution(self._resolution / space.getMaximumExtent())
        information.setup()
        return information

    def _state(self, information: base.SpaceInformation, q: Array) -> base.State:
        state = information.allocState()
        for j, value in enumerate(q * self._levers):
            state[j] = value
        return state

    def _values(self, *states: base.State) -> Array:
        """Return the scaled values of states, (states, joints)."""
        joints = range(len(self._levers))
        return np.array([[state[j] for j in joints] for state in states])


class MotionCheck(base.MotionValidator):  # type: ignore[misc]  # untyped
    """Checks a motion where, and in the order in which, OMPL's own validator does, but with one
    call for all places: a call each took longer than the checks.
    """

    def __init__(
        self, information: base.SpaceInformation, values: Callable[..., Array], free: Free
    ) -> None:
        super().__init__(information)
        # Not `information`, which holds this object: nothing would free the two.
        self._space = information.getStateSpace()
        self._values = values
        self._free = free

    def checkMotion(self, one: base.State, other: base.State) -> bool:  # noqa: N802  # OMPL's name
        """Return whether the motion from `one`, known to be free, to `other` is free."""
        count = max(self._space.validSegmentCount(one, other), 1)
        return self._free(halved.load()(self._values(one, other), count))


@compiled_for("f8[:,::1], i8")
def halved(ends: Array, count: int) -> Array:
    """Return the places at which a line between `ends` (2, joints) in `count` parts is checked,
    (count, joints): its end, its middle, the middles of the halves, and so on.
    """
    places = np.empty((count, ends.shape[1]))
    places[0] = ends[1]
    # First and last mark of each stretch whose middle is a place.
    stretches = np.empty((count + 1, 2), dtype=np.int64)
    stretches[1] = 1, count - 1
    known = 2
    for k in range(1, count):
        first, last = stretches[k]
        middle = (first + last) // 2
        for j in range(ends.shape[1]):
            places[k, j] = ends[0, j] + (ends[1, j] - ends[0, j]) * (middle / count)
        for half in ((first, middle - 1), (middle + 1, last)):
            if half[0] <= half[1]:
                stretches[known] = half
                known += 1
    return places


def lever_arms(cell: Cell, seed: int) -> Array:
    """Return (joints,): the farthest that 1 rad (or 1 m) of each joint moves any geom that it
    carries, in m.

    A joint step dq moves no point of the arm by more than sum |lever_j dq_j|.
    """
    m = cell.model
    data = mujoco.MjData(m)
    rng = np.random.default_rng(seed)
    low, high = sampling_range(cell)
    places = np.empty((LEVER_SAMPLES, m.ngeom, 3))
    anchors, axes = np.empty((2, LEVER_SAMPLES, m.njnt, 3))
    for sample in range(LEVER_SAMPLES):
        data.qpos[cell.qpos] = rng.uniform(low, high)
        mujoco.mj_kinematics(m, data)
        places[sample] = data.geom_xpos
        anchors[sample] = data.xanchor
        axes[sample] = data.xaxis

    def lever(joint: int) -> float:
        if m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            return 1.0
        carried = geoms_of(m, below(m, m.jnt_bodyid[[joint]]))
        moved = np.intersect1d(carried, cell.geoms.arm)
        from_anchor = places[:, moved] - anchors[:, [joint]]
        from_axis = np.linalg.norm(np.cross(from_anchor, axes[:, [joint]]), axis=2)
        return float(np.max(from_axis + m.geom_rbound[moved], initial=0.0))

    return np.array([lever(joint) for joint in m.dof_jntid[cell.dof]])
