"""Counts the contacts that no task means, and tells those of the arm."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.cell import Cell
from rack.levels.touches import geom_name, unmeant


class ContactMonitor:
    """Looks at a cell's contacts after every step of the simulation.

    `count` is the number of unmeant contacts, summed over the steps; `first` names the first one and says when.
    `struck`: the geoms of the newest one of the arm, or of what it holds, since this was last set to None.
    """

    def __init__(self, cell: Cell) -> None:
        self._model = cell.model
        self._touch = cell.touch
        self._arm, self._gripper = np.zeros((2, cell.model.ngeom), dtype=bool)
        self._arm[cell.arm_geoms] = self._gripper[cell.gripper_geoms] = True
        self._root = cell.model.body_rootid[cell.model.geom_bodyid]
        self.count = 0
        self.first = ""
        self.struck: tuple[int, int] | None = None

    def look(self, data: mujoco.MjData, time_s: float) -> None:
        """Count the unmeant contacts of one step at simulated `time_s`."""
        if data.ncon == 0:
            return
        pairs = unmeant(data, self._touch)
        if not len(pairs):
            return
        if not self.first:
            self.first = f"unintended contact: {self.named(pairs[0])} at {time_s:.3f} s"
        self.count += len(pairs)
        ours = pairs[(self._arm | self._held(data))[pairs].any(axis=1)]
        if len(ours):
            self.struck = int(ours[0, 0]), int(ours[0, 1])

    def holds(self, data: mujoco.MjData) -> bool:
        """Say whether the gripper touches a free body."""
        return bool(self._held(data).any())

    def leans(self, data: mujoco.MjData) -> bool:
        """Say whether the arm, or what it holds, touches anything else."""
        ours = self._arm | self._held(data)
        one_sided = ours[data.contact.geom].sum(axis=1) == 1
        return bool((one_sided & (data.contact.dist < 0.0)).any())

    def named(self, pair: tuple[int, int] | NDArray[np.int32]) -> str:
        """Return what touches what."""
        first, second = (geom_name(self._model, geom) for geom in pair)
        return f"'{first}' touches '{second}'"

    def _held(self, data: mujoco.MjData) -> NDArray[np.bool_]:
        """Mark (ngeom,) the geoms of free bodies that the gripper touches."""
        pairs = data.contact.geom
        others = pairs[self._gripper[pairs].any(axis=1)].ravel()
        roots = self._root[others[~self._arm[others]]]
        return np.asarray(np.isin(self._root, roots[roots != 0]))
