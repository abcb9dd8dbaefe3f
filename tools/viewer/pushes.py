"""The pushes of the scene on its objects, as arrows in the cell."""

from __future__ import annotations

import mujoco
import numpy as np
import rerun as rr

from rack.levels.robot.cell import STATE, Cell
from rack.tools.viewer.cell import CELL, POSES_S, WORLD
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import FORCE

LENGTH_M, RADIUS_M = 0.02, 0.0015
"""Length of an arrow for each N, and its radius."""
PUSHES = (CELL, "pushes")


class Pushes:
    """Writes the forces that the scene exerts on its objects, as `ARM_STATE`s have them."""

    def __init__(self, stream: Stream, cell: Cell, clock_ns: int) -> None:
        self._stream, self._cell, self._data = stream, cell, cell.start()
        self._every, self._last = max(1, round(POSES_S * 1e9 / clock_ns)), -1
        self._is_empty = True
        stream.static(PUSHES, stream.within(WORLD))

    def write(self, block: RowBlock) -> None:
        """Write the newest pushes, one set every 20 ms of simulated time."""
        slots, first = np.unique(block.ticks // self._every, return_index=True)
        chosen, self._last = first[slots > self._last], int(slots[-1])
        model, data, bodies = self._cell.model, self._data, self._cell.bodies
        for row in chosen:
            mujoco.mj_setState(model, data, np.ascontiguousarray(block.messages["state"][row]), STATE)
            forces = data.xfrc_applied[bodies, :3]
            pushed = forces.any(axis=1)
            if self._is_empty and not pushed.any():
                continue
            self._is_empty = not pushed.any()
            mujoco.mj_kinematics(model, data)
            arrows = rr.Arrows3D(
                origins=data.xipos[bodies][pushed], vectors=LENGTH_M * forces[pushed], radii=RADIUS_M, colors=[FORCE]
            )
            self._stream.at(int(block.ticks[row]), int(block.stamps_ns[row]), PUSHES, arrows)
