"""Stand-in for an arm with drives: starts one process for each drive, and restarts dead ones.

For your drives, remove `[host.drives]` from the config.
"""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.context import ForkProcess
from time import monotonic

from drive import run_drive
from mechanics import Mechanics
from wire import open_bus

from rack.levels.host_program import Bus, HostProgram
from rack.levels.robot.cell import build_cell

LOOK_S = 0.05
FORK = multiprocessing.get_context("fork")


class Drives(HostProgram):
    """Runs the drives until the rack ends."""

    def run(self, bus: Bus) -> None:
        """Start the drives and restart those that died."""
        context = self.context
        # Without a bus, raise the error once here instead of in every drive.
        open_bus().shutdown()
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        mechanics = Mechanics(cell, monotonic())
        times_s = context.tick_s, cell.patience.ticks(1, context.tick_s) * context.tick_s
        drives: dict[int, ForkProcess] = {}
        while not bus.is_over:
            for node in range(1, len(cell.home) + 1):
                if node not in drives or not drives[node].is_alive():
                    args = (node, mechanics, times_s, os.getpid())
                    drives[node] = FORK.Process(target=run_drive, args=args, daemon=True)
                    drives[node].start()
            bus.wait(LOOK_S)
