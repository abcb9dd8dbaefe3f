"""Forces as arrows in the cell: on a hand's fingertips, and the pushes of the scene on its objects."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun as rr

from rack.levels.algebra import Array
from rack.levels.robot.cell import STATE, Cell
from rack.tools.viewer.cell import CELL, WORLD
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import FORCE

ARROWS_S = 0.02
"""Time between arrows: the rate of a screen."""
LENGTH_M, RADIUS_M = 0.02, 0.0015
"""Length of an arrow for each N, and its radius."""
LEAST_N = 0.05
"""A smaller force has no arrow."""
PUSHES = (CELL, "pushes")


class Arrows:
    """The arrows of one entity."""

    def __init__(self, stream: Stream, entity: Sequence[str], clock_ns: int) -> None:
        self._stream, self._entity = stream, tuple(entity)
        self._every, self._last = max(1, round(ARROWS_S * 1e9 / clock_ns)), -1
        self._is_empty = True
        stream.static(self._entity, stream.within(WORLD))

    def chosen(self, block: RowBlock) -> list[int]:
        """Return the rows of a block to be shown, one every 20 ms."""
        slots, first = np.unique(block.ticks // self._every, return_index=True)
        found = first[slots > self._last].tolist()
        self._last = int(slots[-1])
        return [int(row) for row in found]

    def write(self, block: RowBlock, row: int, points: Array, forces: Array) -> None:
        """Write forces, (n, 3), N, at the points where they act, (n, 3), m."""
        shown = np.abs(forces).max(axis=1, initial=0.0) > LEAST_N
        if self._is_empty and not shown.any():
            return
        self._is_empty = not shown.any()
        vectors = LENGTH_M * forces[shown]
        arrows = rr.Arrows3D(origins=points[shown], vectors=vectors, radii=RADIUS_M, colors=[FORCE])
        self._stream.at(int(block.ticks[row]), int(block.stamps_ns[row]), self._entity, arrows)


class Pushes:
    """Writes the forces that the scene exerts on its objects, as `ARM_STATE`s have them."""

    def __init__(self, stream: Stream, cell: Cell, clock_ns: int) -> None:
        self._cell, self._data = cell, cell.start()
        self._arrows = Arrows(stream, PUSHES, clock_ns)

    def write(self, block: RowBlock) -> None:
        """Write the newest pushes, one set every 20 ms of simulated time."""
        model, data, bodies = self._cell.model, self._data, self._cell.bodies
        for row in self._arrows.chosen(block):
            mujoco.mj_setState(model, data, np.ascontiguousarray(block.messages["state"][row]), STATE)
            mujoco.mj_kinematics(model, data)
            self._arrows.write(block, row, data.xipos[bodies], data.xfrc_applied[bodies, :3])
