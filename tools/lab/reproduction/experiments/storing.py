"""Levels of figure 2 that store data, in the background or in the executor's cycle."""

from __future__ import annotations

import os
import tempfile
import zlib
from functools import cached_property
from typing import IO

from rack.levels.systems.figures import FigureExecutor, FigurePlanner

BLOCK_BYTES = 1 << 20
"""Size of a block. Its compression takes several of the figure's cycles."""


class Storage:
    """Secondary storage: an unnamed file that disappears with its process."""

    def __init__(self) -> None:
        self._block = os.urandom(BLOCK_BYTES)

    @cached_property
    def _file(self) -> IO[bytes]:
        """The file, which is created at the first use."""
        return tempfile.TemporaryFile()

    def store_block(self) -> None:
        """Compress a block, overwrite the previous one in the file, and force it to the disk."""
        os.pwrite(self._file.fileno(), zlib.compress(self._block), 0)
        os.fsync(self._file.fileno())


class StoringPlanner(FigurePlanner):
    """Planner that stores a block with each plan, in the background, where it can be preempted."""

    storage = Storage()

    def plan(self, tick: int) -> None:
        """Write the plan, then store a block."""
        self.output.made_at = tick
        self.storage.store_block()


class StoringExecutor(FigureExecutor):
    """Executor that stores a block in every cycle, and therefore delays its own cycles."""

    storage = Storage()

    def process(self, tick: int) -> None:
        """Run the cycle of the figure, then store a block."""
        super().process(tick)
        self.storage.store_block()
