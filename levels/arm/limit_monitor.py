"""Checks the arm against its bounds after every step of the simulation, knowing nothing of what keeps them."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from levels.cell import Cell

Array = NDArray[np.float64]

WHAT = (("position", "rad"), ("velocity", "rad/s"), ("torque", "N m"))


class LimitMonitor:
    """Records position, velocity and torque, of motor and brake together, step by step; judges once a tick.

    `count` is the number of steps that broke a limit; `first` says which one the first of them broke.
    """

    def __init__(self, cell: Cell, substeps: int) -> None:
        model, bounds, joints = cell.model, cell.bounds, len(cell.qpos)
        joint_of = model.dof_jntid[cell.dof]
        self._names = [model.joint(int(joint)).name for joint in joint_of]
        self._q, self._qd = np.zeros((substeps, model.nq)), np.zeros((substeps, model.nv))
        self._motors, self._brakes = np.zeros((substeps, model.nv)), np.zeros((substeps, model.nv))
        self._columns = (cell.qpos, cell.dof)
        self._seen = np.zeros((3, substeps, joints))
        low, high = bounds.position[:, 0], bounds.position[:, 1]
        self._low = np.stack((low, -bounds.velocity, -bounds.torque))[:, None, :]
        self._high = np.stack((high, bounds.velocity, bounds.torque))[:, None, :]
        self.count = 0
        self.first = ""

    def look(self, data: mujoco.MjData, substep: int) -> None:
        """Record the step that has just been made, number `substep` of its tick."""
        self._q[substep], self._qd[substep] = data.qpos, data.qvel
        self._motors[substep], self._brakes[substep] = data.qfrc_actuator, data.qfrc_applied

    def judge(self, time_s: float) -> None:
        """Judge the steps of one tick that began at simulated `time_s`."""
        seen, (qpos, dof) = self._seen, self._columns
        self._motors += self._brakes
        for part, values in zip((0, 1, 2), (self._q, self._qd, self._motors), strict=True):
            np.take(values, qpos if part == 0 else dof, axis=1, out=seen[part])
        # What is no number is not within limits either.
        if not ((seen >= self._low).all() and (seen <= self._high).all()):
            self._count(time_s)

    def _count(self, time_s: float) -> None:
        wrong = ~((self._seen >= self._low) & (self._seen <= self._high))
        self.count += int(wrong.any(axis=(0, 2)).sum())
        if self.first:
            return
        substep = int(wrong.any(axis=(0, 2)).argmax())
        part, joint = (int(x[0]) for x in np.nonzero(wrong[:, substep]))
        (what, unit), value = WHAT[part], self._seen[part, substep, joint]
        low, high = self._low[part, 0, joint], self._high[part, 0, joint]
        where = f"joint '{self._names[joint]}' at {time_s:.4f} s, step {substep}"
        self.first = f"{what} {value:.6g} {unit} of {where}; {low:g} to {high:g} is permitted"
