"""Counts the contacts that no task means."""

from __future__ import annotations

import mujoco

from levels.cell import Cell
from levels.touches import geom_name, unmeant


class ContactMonitor:
    """Looks at a cell's contacts after every step of the simulation.

    `count` is the number of unmeant contacts, summed over the steps; `first` names the first one and says when.
    """

    def __init__(self, cell: Cell) -> None:
        self._model = cell.model
        self._touch = cell.touch
        self.count = 0
        self.first = ""

    def look(self, data: mujoco.MjData, time_s: float) -> None:
        """Count the unmeant contacts of one step at simulated `time_s`."""
        if data.ncon == 0:
            return
        pairs = unmeant(data, self._touch)
        if len(pairs) and not self.first:
            first, second = (geom_name(self._model, geom) for geom in pairs[0])
            self.first = f"'{first}' touches '{second}' at {time_s:.3f} s"
        self.count += len(pairs)
