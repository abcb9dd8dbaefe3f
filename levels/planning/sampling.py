"""A free polyline in joint space by sampling: OMPL's RRTConnect, then short cuts.

The search ends by the number of configurations checked, never by time, and its random numbers begin anew with every
call: equal questions get equal answers, in every process.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from ompl import base, geometric, util

Array = NDArray[np.float64]

RANGE_PART = 0.2
"""Longest branch of the tree, as a part of the space's extent."""
ENDLESS_RAD = 2.0 * np.pi
"""How far beyond start and goal a joint without limits may go."""

util.setLogLevel(util.LOG_NONE)


class SampledSearch:
    """Searches joint space scaled by `weights` (joints,) for polylines checked every `resolution` of scaled length."""

    def __init__(self, low: Array, high: Array, weights: Array, resolution: float) -> None:
        self._low, self._high = low, high
        self._weights = weights
        self._resolution = resolution

    def search(
        self, start: Array, goal: Array, free: Callable[[Array], bool], seed: int, budget: int
    ) -> tuple[Array | None, int]:
        """Return a free polyline (k, joints), rad, from `start` to `goal`, or None, and the checks that it took.

        `budget` bounds the checks of the search; short cuts take a few of their own.
        """
        util.RNG.setSeed(seed)
        count, scaled = 0, np.zeros(len(start))

        def valid(state: base.State) -> bool:
            nonlocal count
            count += 1
            for j in range(len(scaled)):
                scaled[j] = state[j]
            return free(scaled / self._weights)

        information = self._space(start, goal, valid)
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(self._state(information, start), self._state(information, goal))
        planner = geometric.RRTConnect(information)
        planner.setRange(RANGE_PART * information.getMaximumExtent())
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
        points = [[state[j] for j in range(len(start))] for state in path.getStates()]
        polyline = np.array(points) / self._weights
        # Scaling and back rounds: the ends are those that were asked for.
        polyline[0], polyline[-1] = start, goal
        return polyline, count

    def _space(self, start: Array, goal: Array, valid: Callable[[base.State], bool]) -> base.SpaceInformation:
        joints = len(start)
        low = np.where(np.isfinite(self._low), self._low, np.minimum(start, goal) - ENDLESS_RAD)
        high = np.where(np.isfinite(self._high), self._high, np.maximum(start, goal) + ENDLESS_RAD)
        space, bounds = base.RealVectorStateSpace(joints), base.RealVectorBounds(joints)
        for j in range(joints):
            # The arm may rest a hair beyond a limit: the start counts as inside.
            bounds.setLow(j, float(min(low[j], start[j], goal[j]) * self._weights[j]) - 1e-9)
            bounds.setHigh(j, float(max(high[j], start[j], goal[j]) * self._weights[j]) + 1e-9)
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
