"""Monitors of the simulation: limits exceeded and unintended contacts, independent of the code that
prevents them."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Mask
from rack.levels.arm.substeps import Substeps
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell, unintended_contacts
from rack.levels.robot.lookup import geom_name

QUANTITIES = (("position", "rad"), ("velocity", "rad/s"), ("torque", "N m"))


class LimitMonitor:
    """Judges position, velocity and torque, of motor and brake together, in every step of a tick.

    It shares no code with the limit gate, which enforces the limits.
    """

    def __init__(self, cell: Cell, steps: Substeps) -> None:
        """Judge what `advance` records in `steps`."""
        self._names = [
            cell.model.joint(int(joint)).name for joint in cell.model.dof_jntid[cell.dof]
        ]
        self._seen = steps.seen
        self._low, self._high = steps.judged[:2]
        self.count = 0  # steps in which the drives broke a limit
        # steps in which a blow broke a limit of position or velocity: no drive can prevent it
        self.pushed = 0
        self.first = ""  # the first broken limit, readable
        self.finding = Finding(Alarm.LIMIT_EXCEEDED)  # the newest one

    def judge(self, time_s: float, struck: bool) -> bool:
        """Judge the steps of the tick that began at simulated `time_s`; return whether one broke a
        limit.

        `struck`: a blow still moves the arm.
        """
        wrong = ~(
            (self._seen >= self._low) & (self._seen <= self._high)
        )  # NaN is not within limits either
        if not wrong.any():
            return False
        self._count(wrong, time_s, struck)
        return True

    def _count(self, wrong: Mask, time_s: float, struck: bool) -> None:
        steps = wrong.any(axis=(1, 2))
        if struck:
            pushed = steps & ~wrong[:, 2].any(axis=1) & np.isfinite(self._seen).all(axis=(1, 2))
            self.pushed += int(pushed.sum())
            steps &= ~pushed
            if not steps.any():
                return
        self.count += int(steps.sum())
        substep = int(steps.argmax())
        part, joint = (int(at[0]) for at in np.nonzero(wrong[substep]))
        value = float(self._seen[substep, part, joint])
        self.finding = Finding(Alarm.LIMIT_EXCEEDED, joint, value)
        if self.first:
            return
        what, unit = QUANTITIES[part]
        where = f"joint '{self._names[joint]}' at {time_s:.4f} s, step {substep}"
        permitted = f"{self._low[part, joint]:g} to {self._high[part, joint]:g} is permitted"
        self.first = f"{what} {value:.6g} {unit} of {where}; {permitted}"


class ContactMonitor:
    """Counts the unintended contacts of a cell, in every step that has any."""

    def __init__(self, cell: Cell) -> None:
        self._model = cell.model
        self._touch = cell.touch
        self._arm, self._gripper = np.zeros((2, cell.model.ngeom), dtype=bool)
        self._arm[cell.arm_geoms] = self._gripper[cell.gripper_geoms] = True
        self._root = cell.model.body_rootid[cell.model.geom_bodyid]
        self.count = 0  # unintended contacts, summed over the steps
        self.first = ""  # the first one, readable: which geoms, and when
        self.struck: tuple[int, int] | None = (
            None  # geoms of the newest one of arm or load since last cleared
        )

    def look(self, data: mujoco.MjData) -> None:
        """Count the unintended contacts of the last step."""
        pairs = unintended_contacts(data, self._touch)
        if not len(pairs):
            return
        if not self.first:
            self.first = f"unintended contact: {self.named(pairs[0])} at {data.time:.3f} s"
        self.count += len(pairs)
        ours = pairs[(self._arm | self._held(data))[pairs].any(axis=1)]
        if len(ours):
            self.struck = int(ours[0, 0]), int(ours[0, 1])

    def holds(self, data: mujoco.MjData) -> bool:
        """Return whether the gripper touches a free body."""
        return bool(self._held(data).any())

    def leans(self, data: mujoco.MjData) -> bool:
        """Return whether the arm, or its load, touches anything else."""
        ours = self._arm | self._held(data)
        one_sided = ours[data.contact.geom].sum(axis=1) == 1
        return bool((one_sided & (data.contact.dist < 0.0)).any())

    def named(self, pair: tuple[int, int] | NDArray[np.int32]) -> str:
        """Return a pair in words."""
        first, second = (geom_name(self._model, geom) for geom in pair)
        return f"'{first}' touches '{second}'"

    def _held(self, data: mujoco.MjData) -> Mask:
        """Mark (ngeom,) the geoms of free bodies that the gripper touches."""
        pairs = data.contact.geom
        others = pairs[self._gripper[pairs].any(axis=1)].ravel()
        roots = self._root[others[~self._arm[others]]]
        return np.asarray(np.isin(self._root, roots[roots != 0]))
