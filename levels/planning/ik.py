"""Inverse kinematics: configurations that put the tool at a pose (mink, a differential solver with restarts)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from typing import Any

import mink
import numpy as np
from numpy.typing import NDArray

from levels.cell import Cell
from levels.planning.pose import Pose, pose
from levels.planning.reach import sampling_range

Array = NDArray[np.float64]

RESTARTS = 40
"""Random starts for one pose, at most: of 200 random poses of the PUMA, 20 starts missed one."""
PATIENCE = 8
"""Starts in a row that bring no new solution and end the search, once there is one."""
MOST_SOLUTIONS = 8
"""Solutions of one pose, at most: a redundant arm has infinitely many."""
ITERATIONS = 25
STALLED_ITERATIONS = 5
STALLED_PART = 0.7
"""A descent whose error has not come down to this part within that many iterations is given up."""
POSITION_TOLERANCE_M = 1e-5
ANGLE_TOLERANCE_RAD = 1e-5
SAME_RAD = 1e-2
"""Solutions nearer than this in every joint are one solution."""
LIMIT_MARGIN_RAD = 1e-2
"""Solutions stay this far inside the position limits: the limit gate of the servo level brakes there."""
MEET_RAD = 0.5
"""A warm start that ends farther away than this in a joint has left its branch."""


class InverseKinematics:
    """Solves for the tool of one arm. Pure: equal arguments give equal answers."""

    def __init__(self, cell: Cell, seed: int) -> None:
        self._cell = cell
        self._seed = seed
        self._pace = 1.0 / cell.limits.velocity
        model = copy.copy(cell.model)
        self._bound_joints(model)
        self._configuration = mink.Configuration(model)
        self._tool = model.site(cell.tool).name
        self._task = mink.FrameTask(self._tool, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
        self._limits = [mink.ConfigurationLimit(model)]
        others = np.setdiff1d(np.arange(model.nv), cell.dof).tolist()
        self._frozen = [mink.DofFreezingTask(model, others)] if others else None
        self._low, self._high = sampling_range(cell)

    def tool_at(self, q: Array) -> Pose:
        """Return the tool's pose at `q` (joints,), rad."""
        self._move_to(q)
        placed = self._configuration.get_transform_frame_to_world(self._tool, "site")
        return pose(placed.translation(), placed.rotation().wxyz)

    def reach(self, target: Pose, start: Array) -> Array | None:
        """Return the configuration (joints,) at `target` that one descent from `start` finds, or None."""
        self._task.set_target(mink.SE3(np.concatenate([target.quaternion, target.position])))
        self._move_to(np.clip(start, self._inner_low, self._inner_high))
        errors: list[float] = []
        for _ in range(ITERATIONS):
            error = self._task.compute_error(self._configuration)
            if max(abs(error[:3])) < POSITION_TOLERANCE_M and max(abs(error[3:])) < ANGLE_TOLERANCE_RAD:
                return np.array(self._configuration.q[self._cell.qpos])
            errors.append(float(np.linalg.norm(error)))
            if len(errors) > STALLED_ITERATIONS and errors[-1] > STALLED_PART * errors[-1 - STALLED_ITERATIONS]:
                return None
            try:
                velocity = mink.solve_ik(
                    self._configuration, [self._task], 1.0, "daqp", 1e-6, limits=self._limits, constraints=self._frozen
                )
            except mink.NoSolutionFound:
                return None
            self._configuration.integrate_inplace(velocity, 1.0)
        return None

    def nearby(self, target: Pose, start: Array) -> Array | None:
        """Return the configuration at `target` on the branch of `start`, or None when there is none near."""
        found = self.reach(target, start)
        return found if found is not None and bool(np.all(np.abs(found - start) < MEET_RAD)) else None

    def solutions(self, target: Pose, reference: Array, free: Callable[[Array], bool]) -> list[Array]:
        """Return distinct free configurations at `target`, the quickest to get to from `reference` first.

        The list is empty when `target` is out of reach or everything there collides.
        """
        return [q for q in self.reachable(target, reference) if free(q)]

    def reachable(self, target: Pose, reference: Array) -> list[Array]:
        """Return distinct configurations at `target`, free or not, the quickest to get to first."""
        rng = np.random.default_rng(self._seed)
        found: list[Array] = []
        idle = 0
        for start in self._starts(reference, rng):
            q = self.reach(target, start)
            known = q is None or any(np.all(np.abs(q - other) < SAME_RAD) for other in found)
            idle = idle + 1 if known else 0
            if q is not None and not known:
                found.append(q)
            if len(found) == MOST_SOLUTIONS or (found and idle >= PATIENCE):
                break
        return sorted(found, key=lambda q: self.time_between(reference, q))

    def time_between(self, one: Array, other: Array) -> float:
        """Return the time, in s, of the slowest joint from `one` to `other` at its velocity limit."""
        return float(np.max(np.abs(one - other) * self._pace))

    def _starts(self, reference: Array, rng: np.random.Generator) -> Iterable[Array]:
        yield reference
        for _ in range(RESTARTS):
            yield rng.uniform(self._low, self._high)

    def _move_to(self, q: Array) -> None:
        whole = self._configuration.q
        whole[self._cell.qpos] = q
        self._configuration.update(whole)

    def _bound_joints(self, model: Any) -> None:
        """Give `model` the arm's position limits, a margin inside."""
        limits = self._cell.limits.position
        self._inner_low, self._inner_high = limits[:, 0] + LIMIT_MARGIN_RAD, limits[:, 1] - LIMIT_MARGIN_RAD
        joints = self._cell.model.dof_jntid[self._cell.dof]
        limited = np.isfinite(limits).all(axis=1)
        model.jnt_limited[joints] = limited
        model.jnt_range[joints[limited], 0] = self._inner_low[limited]
        model.jnt_range[joints[limited], 1] = self._inner_high[limited]
