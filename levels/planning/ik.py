"""Inverse kinematics: configurations that put the tool at a pose, by damped least squares with
restarts.

A step is a quadratic program bounded by the joints' limits; MuJoCo solves it. Alternative
considered: mink, which does the same on numpy and a solver of choice, but the bits of its matrix
products depend on the processor.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from rack.levels.algebra import Array, gram, norm, transposed_mat_vec
from rack.levels.planning.pose import Pose, site_pose
from rack.levels.robot.cell import Cell

MAX_RESTARTS = 60
"""Random starts for one pose: of 300 random poses of the K-1607, 40 starts missed one."""
MAX_IDLE_STARTS = 12
"""Consecutive starts without a new solution that end the search, once there is a solution."""
MAX_SOLUTIONS = 8
"""Solutions of one pose: a redundant arm has infinitely many."""
MAX_ITERATIONS = 25
STALLED_ITERATIONS = 5
STALLED_PART = 0.7
"""A descent is abandoned when its error has not fallen to this part within `STALLED_ITERATIONS`."""
TOLERANCE = 1e-5
"""Of each part of the tool's error, in m and in rad."""
SAME_RAD = 1e-2
"""Solutions closer than this in every joint count as one."""
LIMIT_MARGIN_RAD = 1e-2
"""Solutions stay this far inside the position limits: the limit gate of the servo level brakes
there."""
MAX_BRANCH_STEP_RAD = 0.5
"""A warm start that ends farther away than this in a joint has left its branch."""
DAMPING = 1e-6
"""Damping of a step, in squared tool error per rad, and as much again for an error of 1 m or 1
rad."""
LIMIT_PART = 0.95
"""Part of the way to a position limit that one step may take."""


class InverseKinematics:
    """Solves for the tool of one arm. Pure: equal arguments give equal results."""

    def __init__(self, cell: Cell, seed: int) -> None:
        self._cell = cell
        self._seed = seed
        self._pace = 1.0 / cell.limits.velocity
        limits = cell.limits.position
        self._inner_low = limits[:, 0] + LIMIT_MARGIN_RAD
        self._inner_high = limits[:, 1] - LIMIT_MARGIN_RAD
        self._data = mujoco.MjData(cell.model)
        joints = len(cell.qpos)
        self._jacobian = np.zeros((6, cell.model.nv))
        self._factor = np.zeros((joints, joints + 7))  # room for the solver
        self._low, self._high = sampling_range(cell)

    def tool_at(self, q: Array) -> Pose:
        """Return the tool's pose at `q` (joints,), rad."""
        self._data.qpos[self._cell.qpos] = q
        mujoco.mj_kinematics(self._cell.model, self._data)
        return site_pose(self._data, self._cell.tool)

    def reach(self, target: Pose, start: Array, turned: bool = True) -> Array | None:
        """Return the configuration (joints,) at `target` found by one descent from `start`, or
        None; without `turned` in any orientation.
        """
        q = np.clip(start, self._inner_low, self._inner_high)
        errors: list[float] = []
        for _ in range(MAX_ITERATIONS):
            error = self._error(target, q)
            if not turned:
                error[3:] = 0.0
            if (np.abs(error) < TOLERANCE).all():
                return q
            errors.append(norm(error))
            if (
                len(errors) > STALLED_ITERATIONS
                and errors[-1] > STALLED_PART * errors[-1 - STALLED_ITERATIONS]
            ):
                return None
            step = self._step(error, q, turned)
            if step is None:
                return None
            q = q + step
        return None

    def nearby(self, target: Pose, start: Array) -> Array | None:
        """Return the configuration at `target` on the branch of `start`; None: there is none
        nearby.
        """
        found = self.reach(target, start)
        return (
            found
            if found is not None and bool(np.all(np.abs(found - start) < MAX_BRANCH_STEP_RAD))
            else None
        )

    def solutions(
        self,
        target: Pose,
        reference: Array,
        free: Callable[[Array], bool],
        restarts: int = MAX_RESTARTS,
    ) -> list[Array]:
        """Return distinct free configurations at `target`, the quickest to reach from `reference`
        first.

        Empty when `target` is out of reach or everything there collides.
        """
        return [q for q in self.reachable(target, reference, restarts=restarts) if free(q)]

    def reachable(
        self, target: Pose, reference: Array, turned: bool = True, restarts: int = MAX_RESTARTS
    ) -> list[Array]:
        """Return distinct configurations at `target`, free or not, the quickest to reach first;
        without `turned` in any orientation.
        """
        rng = np.random.default_rng(self._seed)
        found: list[Array] = []
        idle = 0
        start = reference
        for _ in range(1 + restarts):
            q = self.reach(target, start, turned)
            known = q is None or any(np.all(np.abs(q - other) < SAME_RAD) for other in found)
            idle = idle + 1 if known else 0
            if q is not None and not known:
                found.append(q)
            if len(found) == MAX_SOLUTIONS or (found and idle >= MAX_IDLE_STARTS):
                break
            start = rng.uniform(self._low, self._high)
        return sorted(found, key=lambda q: self.time_between(reference, q))

    def time_between(self, one: Array, other: Array) -> float:
        """Return the time, in s, of the slowest joint from `one` to `other` at its velocity
        limit.
        """
        return float(np.max(np.abs(one - other) * self._pace))

    def _error(self, target: Pose, q: Array) -> Array:
        """Return (6,): the way, m, and the turn, rad, from the tool at `q` to `target`; world
        frame.
        """
        tool = self.tool_at(q)
        turn = np.zeros(3)
        error = np.zeros(6)
        error[:3] = target.position - tool.position
        mujoco.mju_subQuat(turn, target.quaternion, tool.quaternion)
        mujoco.mju_rotVecQuat(error[3:], turn, tool.quaternion)
        return error

    def _step(self, error: Array, q: Array, turned: bool) -> Array | None:
        """Return the step (joints,), rad, that best reduces `error`, the error at `q`; None: there
        is none.
        """
        m = self._cell.model
        d = self._data
        mujoco.mj_comPos(m, d)
        mujoco.mj_jacSite(m, d, self._jacobian[:3], self._jacobian[3:], self._cell.tool)
        jacobian = self._jacobian.take(self._cell.dof, axis=1)
        if not turned:
            jacobian[3:] = 0.0
        hessian = gram(jacobian)
        step = np.zeros(len(q))
        hessian.ravel()[:: len(q) + 1] += DAMPING * (1.0 + norm(error) ** 2)
        gradient = transposed_mat_vec(jacobian, -error)
        low = LIMIT_PART * (self._inner_low - q)
        high = LIMIT_PART * (self._inner_high - q)
        rank = mujoco.mju_boxQP(step, self._factor, None, hessian, gradient, low, high)
        return step if rank >= 0 else None


def sampling_range(cell: Cell) -> tuple[Array, Array]:
    """Return low and high (joints,), in rad: the limits, or one turn for a joint without limits."""
    low = cell.limits.position[:, 0]
    high = cell.limits.position[:, 1]
    return np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
