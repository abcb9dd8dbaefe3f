"""Collision-free paths between two configurations, with rounded corners.

A path is a straight line if that is free of collisions. Otherwise OMPL's RRTConnect searches for a
path, which is then shortened. A search is limited by its number of checks, not by time, and every
call seeds the random numbers, so equal arguments give equal paths in every process.
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
from rack.levels.planning.ik import find_sampling_range
from rack.levels.robot.cell import Cell
from rack.levels.robot.lookup import list_geoms, mark_descendants

Free = Callable[[Array], bool]
"""Returns True if all of the configurations (n, joints) are free."""
FirstBlocked = Callable[[Array], int]
"""Returns the index of the first of n configurations, (n, joints), rad, that is not free, or n."""

MAX_CHECKS = 24_000
"""Maximum number of configurations checked by all searches of a plan, which bounds its time."""
MAX_SEARCHES = 6
"""Maximum number of searches of one plan, each with another seed. The quickest path is taken."""
MAX_SEED = 2**31 - 1
STEP_PART = 0.5
"""Part of the clearance that any point of the arm moves at most between two checks."""
MIN_LEVER_M = 0.05
"""Minimum weight of a joint in the metric, for joints that hardly move any geom."""
LEVER_SAMPLES = 64
"""Number of random configurations in which lever arms are measured."""
BLENDS = (1.0, 0.6, 0.35, 0.2, 0.1)
"""Parts of the largest blend that are tried at a corner. If all collide, the motion stops at the
corner."""
END_PART = 0.9
"""Part of the first and of the last line that a blend may use."""
BRANCH_PART = 0.2
"""Longest branch of the search tree, as a part of the extent of the space."""
ENDLESS_RAD = 2.0 * np.pi
"""Range of the search beyond start and goal for a joint without limits."""
BOUND_ROUNDING = 1e-9
"""Margin of the bounds of the space, in scaled length, so that rounding does not exclude start or
goal."""

util.setLogLevel(util.LOG_NONE)


class PathPlanner:
    """Plans paths for one arm. Equal arguments give equal paths."""

    def __init__(self, cell: Cell, clearance: float, seed: int) -> None:
        self._limits = cell.limits
        self._seed = seed
        self._levers = np.maximum(compute_lever_arms(cell, seed), MIN_LEVER_M)
        # Because sum |lever_j dq_j| <= |lever| |dq|, a step of this length moves no point farther
        # than intended.
        self.step_rad = STEP_PART * clearance / norm(self._levers)
        # Scaled length between two checks.
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
        """Return the quickest path found, or None.

        Args:
            start: Configuration at the start, (joints,), rad.
            goal: Configuration at the end, (joints,), rad.
            first_blocked: Finds the first configuration that is not free.
            attempt: Number of the attempt in the same world. Each one uses other random numbers.
            searches: Number of paths among which the quickest is selected.
        """
        ends = np.array([start, goal])
        if first_blocked(ends) < len(ends):
            return None
        count = int(np.ceil(norm(goal - start) / self.step_rad)) + 1
        line = np.linspace(start, goal, max(count, 2))
        if first_blocked(line) == len(line):
            return Path(ends, np.zeros(2))
        paths = self._search_paths(ends, first_blocked, attempt, searches)
        if len(paths) == 1:
            return paths[0]
        return min(paths, key=self.compute_duration, default=None)

    def round_corners(self, waypoints: Array, first_blocked: FirstBlocked) -> Path:
        """Return the path along `waypoints`, with corners rounded as far as collisions permit.

        Args:
            waypoints: Waypoints, (n, joints), rad.
            first_blocked: Finds the first configuration that is not free.
        """
        # Blends must not overlap: they use up to half of an inner line, and most of the first and
        # the last line.
        lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        largest_blends = 0.5 * lengths
        largest_blends[[0, -1]] = END_PART * lengths[[0, -1]] if len(lengths) > 1 else 0.0
        blend = np.zeros(len(waypoints))
        blend[1:-1] = np.minimum(largest_blends[:-1], largest_blends[1:])
        for corner in range(1, len(waypoints) - 1):
            largest = float(blend[corner])
            blend[corner] = self._find_free_blend(waypoints, corner, largest, first_blocked)
        return Path(waypoints, blend)

    def find_blocked_configuration(self, path: Path, first_blocked: FirstBlocked) -> Array | None:
        """Return the first configuration on `path` that is not free, or None."""
        samples = BlendedPath(*path).sample_points(self.step_rad)
        index = first_blocked(samples)
        return samples[index] if index < len(samples) else None

    def compute_duration(self, path: Path) -> float:
        """Return the duration of `path`, from rest to rest, in s."""
        return make_trajectory(BlendedPath(*path), self._limits).duration

    def _search_paths(
        self, ends: Array, first_blocked: FirstBlocked, attempt: int, searches: int
    ) -> list[Path]:
        """Search for paths around obstacles, and return at most `searches` of them.

        The search ends early after `MAX_CHECKS` collision checks or `MAX_SEARCHES` attempts.

        Args:
            ends: Start and goal, (2, joints), rad.
            first_blocked: Finds the first configuration that is not free.
            attempt: Selects the random numbers.
            searches: Number of paths to find.
        """
        paths: list[Path] = []
        checks_left = MAX_CHECKS
        for k in range(MAX_SEARCHES):
            seed = 1 + (self._seed + attempt * MAX_SEARCHES + k) % MAX_SEED
            polyline, checks = self._search_once(ends, first_blocked, seed, checks_left)
            checks_left -= checks
            if polyline is not None and len(polyline) <= WAYPOINTS:
                paths.append(self.round_corners(polyline, first_blocked))
            if checks_left <= 0 or len(paths) == searches:
                break
        return paths

    def _find_free_blend(
        self, waypoints: Array, corner: int, largest: float, first_blocked: FirstBlocked
    ) -> float:
        """Return the largest collision-free blend at a corner, in rad. 0 if there is none.

        Args:
            waypoints: Waypoints of the path, (n, joints), rad.
            corner: Index of the corner.
            largest: Largest blend to try, rad.
            first_blocked: Finds the first configuration that is not free.
        """
        before, at, after = waypoints[corner - 1 : corner + 2]
        for fraction in BLENDS:
            b = fraction * largest
            ends = [at + b * (end - at) / max(norm(end - at), b) for end in (before, after)]
            path = Path(np.array([ends[0], at, ends[1]]), np.array([0.0, b, 0.0]))
            if self.find_blocked_configuration(path, first_blocked) is None:
                return b
        return 0.0

    def _search_once(
        self, ends: Array, first_blocked: FirstBlocked, seed: int, budget: int
    ) -> tuple[Array | None, int]:
        """Search for a collision-free polyline, in joint space scaled by the lever arms.

        Args:
            ends: Start and goal, (2, joints), rad.
            first_blocked: Finds the first configuration that is not free.
            seed: Seed of the random numbers.
            budget: Number of collision checks after which the search ends. Shortening the result
                takes a few more.

        Returns:
            Polyline, (k, joints), rad, or None, and the number of configurations checked.
        """
        util.RNG.setSeed(seed)
        count = 0

        def is_free(scaled: Array) -> bool:
            """Return True if all scaled configurations are free, and count the checks."""
            nonlocal count
            index = first_blocked(scaled / self._levers)
            count += min(index + 1, len(scaled))
            return index == len(scaled)

        information = self._build_space(ends, is_free)
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(*(self._to_state(information, end) for end in ends))
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
        polyline = self._to_values(*path.getStates()) / self._levers
        # Scaling introduces rounding errors, so restore the exact ends.
        polyline[[0, -1]] = ends
        return polyline, count

    def _build_space(self, ends: Array, free: Free) -> base.SpaceInformation:
        """Build the scaled space of OMPL around start and goal, with its collision check.

        Args:
            ends: Start and goal, (2, joints), rad.
            free: Checks scaled configurations.
        """
        least = ends.min(axis=0)
        highest = ends.max(axis=0)
        low, high = self._limits.position.T
        low = np.where(np.isfinite(low), low, least - ENDLESS_RAD)
        high = np.where(np.isfinite(high), high, highest + ENDLESS_RAD)
        space = base.RealVectorStateSpace(len(least))
        bounds = base.RealVectorBounds(len(least))
        # The arm may rest slightly beyond a limit, so the bounds include the start.
        for j, value in enumerate(np.minimum(low, least) * self._levers - BOUND_ROUNDING):
            bounds.setLow(j, value)
        for j, value in enumerate(np.maximum(high, highest) * self._levers + BOUND_ROUNDING):
            bounds.setHigh(j, value)
        space.setBounds(bounds)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(lambda state: free(self._to_values(state)))
        information.setMotionValidator(MotionCheck(information, self._to_values, free))
        information.setStateValidityCheckingResolution(self._resolution / space.getMaximumExtent())
        information.setup()
        return information

    def _to_state(self, information: base.SpaceInformation, q: Array) -> base.State:
        """Return the OMPL state of a configuration.

        Args:
            information: Scaled space of OMPL.
            q: Configuration, (joints,), rad.
        """
        state = information.allocState()
        for j, value in enumerate(q * self._levers):
            state[j] = value
        return state

    def _to_values(self, *states: base.State) -> Array:
        """Return the scaled values of OMPL states, (states, joints)."""
        joints = range(len(self._levers))
        return np.array([[state[j] for j in joints] for state in states])


class MotionCheck(base.MotionValidator):  # type: ignore[misc]  # untyped
    """Checks motions in the same order as OMPL's own validator, but with one call per motion.

    A separate call for each configuration took longer than the checks themselves.
    """

    def __init__(
        self, information: base.SpaceInformation, values: Callable[..., Array], free: Free
    ) -> None:
        super().__init__(information)
        # Keeping `information`, which refers to this object, would make a cycle that nothing frees.
        self._space = information.getStateSpace()
        self._values = values
        self._free = free

    def checkMotion(self, one: base.State, other: base.State) -> bool:  # noqa: N802  # OMPL's name
        """Return True if the motion from `one`, which is known to be free, to `other` is free."""
        count = max(self._space.validSegmentCount(one, other), 1)
        return self._free(
            list_bisection_points.load_machine_code()(self._values(one, other), count)
        )


@compiled_for("f8[:,::1], i8")
def list_bisection_points(ends: Array, count: int) -> Array:
    """Return points of a line in the order in which to check them: its end, then by bisection.

    Args:
        ends: Ends of the line, (2, joints).
        count: Number of equal sections of the line.

    Returns:
        Points, (count, joints).
    """
    places = np.empty((count, ends.shape[1]))
    places[0] = ends[1]
    # First and last index of each stretch whose middle becomes a point.
    stretches = np.empty((count + 1, 2), dtype=np.int64)
    stretches[1] = 1, count - 1
    stretch_count = 2
    for k in range(1, count):
        first, last = stretches[k]
        middle = (first + last) // 2
        places[k] = ends[0] + (ends[1] - ends[0]) * (middle / count)
        for half in ((first, middle - 1), (middle + 1, last)):
            if half[0] <= half[1]:
                stretches[stretch_count] = half
                stretch_count += 1
    return places


def compute_lever_arms(cell: Cell, seed: int) -> Array:
    """Return the largest distance by which a unit motion of each joint can move a geom of the arm.

    A joint step dq moves no point of the arm by more than sum |lever_j dq_j|.

    Args:
        cell: Model of the arm.
        seed: Seed of the random configurations at which the distances are measured.

    Returns:
        Lever arms, (joints,), m per rad. They are 1 for sliding joints.
    """
    m = cell.model
    data = mujoco.MjData(m)
    rng = np.random.default_rng(seed)
    low, high = find_sampling_range(cell)
    places = np.empty((LEVER_SAMPLES, m.ngeom, 3))
    anchors, axes = np.empty((2, LEVER_SAMPLES, m.njnt, 3))
    for sample in range(LEVER_SAMPLES):
        data.qpos[cell.qpos] = rng.uniform(low, high)
        mujoco.mj_kinematics(m, data)
        places[sample] = data.geom_xpos
        anchors[sample] = data.xanchor
        axes[sample] = data.xaxis

    def measure_lever(joint: int) -> float:
        """Return the largest distance from the axis of a joint to a geom that it moves."""
        if m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
            return 1.0
        carried = list_geoms(m, mark_descendants(m, m.jnt_bodyid[[joint]]))
        moved = np.intersect1d(carried, cell.geoms.arm)
        from_anchor = places[:, moved] - anchors[:, [joint]]
        from_axis = np.linalg.norm(np.cross(from_anchor, axes[:, [joint]]), axis=2)
        return float(np.max(from_axis + m.geom_rbound[moved], initial=0.0))

    return np.array([measure_lever(joint) for joint in m.dof_jntid[cell.dof]])
