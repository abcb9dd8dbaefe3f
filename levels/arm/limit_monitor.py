"""Checks the arm against its bounds after every step of the simulation, knowing nothing of what keeps them."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.cell import Cell

Array = NDArray[np.float64]

WHAT = (("position", "rad"), ("velocity", "rad/s"), ("torque", "N m"))


class LimitMonitor:
    """Records position, velocity and torque, of motor and brake together, step by step; judges once a tick.

    `count` is the number of steps that broke a limit; `first` says which one the first of them broke. Steps in which
    a blow pushes joints beyond limits of position or velocity, and no torque is beyond its own, are counted in
    `pushed`: no drive can prevent them.
    """

    def __init__(self, cell: Cell, data: mujoco.MjData, substeps: int) -> None:
        """Watch `data`, of which a tick takes `substeps` steps."""
        model, bounds = cell.model, cell.bounds
        self._names = [model.joint(int(joint)).name for joint in model.dof_jntid[cell.dof]]
        # Whole rows are recorded, at no more cost than the arm's part of them; what is not the arm's has no limits.
        self._live = data.qpos, data.qvel, data.qfrc_actuator, data.qfrc_applied
        ends = np.cumsum([model.nq, model.nv, model.nv])
        self._seen = np.zeros((substeps, ends[-1]))
        self._parts = [tuple(np.split(row, ends[:-1])) for row in self._seen]
        self._columns = np.stack((cell.qpos, ends[0] + cell.dof, ends[1] + cell.dof))
        self._low, self._high = np.full(ends[-1], -np.inf), np.full(ends[-1], np.inf)
        self._low[self._columns] = np.stack((bounds.position[:, 0], -bounds.velocity, -bounds.torque))
        self._high[self._columns] = np.stack((bounds.position[:, 1], bounds.velocity, bounds.torque))
        self.count = 0
        self.pushed = 0
        self.first = ""

    def look(self, substep: int) -> None:
        """Record the step that has just been made, number `substep` of its tick."""
        q, qd, motors, brakes = self._live
        position, velocity, torque = self._parts[substep]
        position[:] = q
        velocity[:] = qd
        np.add(motors, brakes, out=torque)

    def judge(self, time_s: float, struck: bool) -> bool:
        """Judge the steps of one tick that began at simulated `time_s`; say whether one broke a limit.

        `struck`: the arm has been struck, and moves on from that.
        """
        # What is no number is not within limits either. (To count is five times as fast as to ask for all.)
        within = np.count_nonzero(self._seen >= self._low) + np.count_nonzero(self._seen <= self._high)
        if within == 2 * self._seen.size:
            return False
        self._count(time_s, struck)
        return True

    def _count(self, time_s: float, struck: bool) -> None:
        wrong = ~((self._seen >= self._low) & (self._seen <= self._high))
        steps = wrong.any(axis=1)
        if struck:
            pushed = steps & ~wrong[:, self._columns[2]].any(axis=1) & np.isfinite(self._seen).all(axis=1)
            self.pushed += int(pushed.sum())
            steps &= ~pushed
            if not steps.any():
                return
        self.count += int(steps.sum())
        if self.first:
            return
        substep = int(steps.argmax())
        part, joint = (int(at[0]) for at in np.nonzero(wrong[substep, self._columns]))
        column = self._columns[part, joint]
        what, unit = WHAT[part]
        where = f"joint '{self._names[joint]}' at {time_s:.4f} s, step {substep}"
        permitted = f"{self._low[column]:g} to {self._high[column]:g} is permitted"
        self.first = f"{what} {self._seen[substep, column]:.6g} {unit} of {where}; {permitted}"
