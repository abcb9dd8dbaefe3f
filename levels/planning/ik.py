"""Inverse kinematics: joint configurations that put the tool at a pose.

It uses damped least squares with random restarts. A step is a quadratic program bounded by the
joint limits, which MuJoCo solves. The library mink does the same on numpy and a solver of choice,
but the last bits of its matrix products depend on the processor.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import Array, gram, norm, transposed_mat_vec
from rack.levels.planning.pose import Pose, read_site_pose
from rack.levels.robot.cell import Cell

MAX_RESTARTS = 60
"""Maximum number of random starts for one pose. With 40, one of 300 random poses was missed."""
MAX_IDLE_STARTS = 12
"""Number of consecutive starts without a new solution that end the search, after the first one."""
MAX_SOLUTIONS = 8
"""Maximum number of solutions for one pose. A redundant arm has infinitely many."""
MAX_ITERATIONS = 25
"""Maximum number of steps from one start."""
STALLED_ITERATIONS = 5
STALLED_PART = 0.7
"""A descent is abandoned if its error has not fallen to this part within `STALLED_ITERATIONS`."""
TOLERANCE = 1e-5
"""Permitted error in each component of the tool's pose, m or rad."""
SAME_RAD = 1e-2
"""Solutions closer than this in every joint count as one."""
LIMIT_MARGIN_RAD = 1e-2
"""Distance of solutions from the position limits, because the limit gate of the servo level brakes
near them."""
MAX_BRANCH_STEP_RAD = 0.5
"""A solution farther than this from its start in any joint is on another branch."""
DAMPING = 1e-6
"""Damping of a step, in squared tool error per squared joint step. It doubles at an error of 1 m or
1 rad."""
LIMIT_PART = 0.95
"""Part of the distance to a position limit that one step may cover."""


class InverseKinematics:
    """Inverse kinematics of one arm. Equal arguments give equal results."""

    def __init__(self, cell: Cell, seed: int) -> None:
        self._cell = cell
        self._seed = seed
        self._pace = 1.0 / cell.limits.velocity
        low, high = cell.limits.position.T
        self._inner_low = low + LIMIT_MARGIN_RAD
        self._inner_high = high - LIMIT_MARGIN_RAD
        self._data = mujoco.MjData(cell.model)
        joints = len(cell.qpos)
        self._jacobian = np.zeros((6, cell.model.nv))
        self._factor = np.zeros((joints, joints + 7))  # work space of the solver

    def compute_tool_pose(self, q: Array) -> Pose:
        """Return the pose of the tool at a configuration.

        Args:
            q: Configuration, (joints,), rad.
        """
        self._data.qpos[self._cell.qpos] = q
        mujoco.mj_kinematics(self._cell.model, self._data)
        return read_site_pose(self._data, self._cell.tool)

    def find_configuration(
        self, target: Pose, start: Array, match_orientation: bool = True
    ) -> Array | None:
        """Find a configuration that puts the tool at a pose, by an iterative search from `start`.

        Args:
            target: Pose for the tool.
            start: Configuration to start from, (joints,), rad.
            match_orientation: False accepts any orientation of the tool.

        Returns:
            Configuration, (joints,), rad, or None if the iteration does not converge.
        """
        q = np.clip(start, self._inner_low, self._inner_high)
        errors: list[float] = []
        for _ in range(MAX_ITERATIONS):
            error = self.compute_tool_pose(q).compute_error(target)
            if not match_orientation:
                error[3:] = 0.0
            if (np.abs(error) < TOLERANCE).all():
                return q
            errors.append(norm(error))
            if (
                len(errors) > STALLED_ITERATIONS
                and errors[-1] > STALLED_PART * errors[-1 - STALLED_ITERATIONS]
            ):
                return None
            step = self._compute_step(error, q, match_orientation)
            if step is None:
                return None
            q = q + step
        return None

    def find_nearby(self, target: Pose, start: Array) -> Array | None:
        """Return a configuration that reaches `target` on the same branch as `start`, or None."""
        solution = self.find_configuration(target, start)
        if solution is None or not np.all(np.abs(solution - start) < MAX_BRANCH_STEP_RAD):
            return None
        return solution

    def find_solutions(
        self,
        target: Pose,
        reference: Array,
        match_orientation: bool = True,
        restarts: int = MAX_RESTARTS,
    ) -> list[Array]:
        """Find distinct configurations, free or not, the quickest to reach first.

        Args:
            target: Pose for the tool.
            reference: Configuration from which the arm moves to them, (joints,), rad.
            match_orientation: False accepts any orientation of the tool.
            restarts: Maximum number of random starts.

        Returns:
            Configurations, (joints,), rad.
        """
        rng = np.random.default_rng(self._seed)
        solutions: list[Array] = []
        idle = 0
        start = reference
        for _ in range(1 + restarts):
            q = self.find_configuration(target, start, match_orientation)
            is_known = q is None or any(np.all(np.abs(q - other) < SAME_RAD) for other in solutions)
            idle = idle + 1 if is_known else 0
            if q is not None and not is_known:
                solutions.append(q)
            if len(solutions) == MAX_SOLUTIONS or (solutions and idle >= MAX_IDLE_STARTS):
                break
            start = rng.uniform(*find_sampling_range(self._cell))
        return sorted(solutions, key=lambda q: self.compute_travel_time(reference, q))

    def compute_travel_time(self, start: Array, end: Array) -> float:
        """Return the time in s that the slowest joint needs at its velocity limit."""
        return float(np.max(np.abs(start - end) * self._pace))

    def _compute_step(self, error: Array, q: Array, match_orientation: bool) -> Array | None:
        """Return the bounded step that best reduces the error.

        Args:
            error: Error at `q`.
            q: Configuration, (joints,), rad.
            match_orientation: False ignores the orientation.

        Returns:
            Step, (joints,), rad, or None if the solver finds none.
        """
        m = self._cell.model
        d = self._data
        mujoco.mj_comPos(m, d)
        mujoco.mj_jacSite(m, d, self._jacobian[:3], self._jacobian[3:], self._cell.tool)
        jacobian = self._jacobian.take(self._cell.dof, axis=1)
        if not match_orientation:
            jacobian[3:] = 0.0
        hessian = gram(jacobian)
        step = np.zeros(len(q))
        hessian.ravel()[:: len(q) + 1] += DAMPING * (1.0 + norm(error) ** 2)
        gradient = transposed_mat_vec(jacobian, -error)
        low = LIMIT_PART * (self._inner_low - q)
        high = LIMIT_PART * (self._inner_high - q)
        rank = mujoco.mju_boxQP(step, self._factor, None, hessian, gradient, low, high)
        return step if rank >= 0 else None


def find_sampling_range(cell: Cell) -> tuple[Array, Array]:
    """Return the range from which random configurations are drawn.

    Returns:
        Lowest and highest positions, (joints,), rad: the position limits, or -pi and pi where a
        joint has none.
    """
    low, high = cell.limits.position.T
    return np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
