"""Levels of figure 2 that store data, in the background or in the cycle of the executor."""

from __future__ import annotations

import os
import tempfile
import zlib
from functools import cached_property
from typing import IO

from rack.levels.systems.figures import FigureExecutor, FigurePlanner

BLOCK_BYTES = 1 << 20
"""Size of a block; to compress it takes several of the figure's cycles."""


class Storage:
    """Secondary storage: a file without a name, gone with its process."""

    def __init__(self) -> None:
        self._block = os.urandom(BLOCK_BYTES)

    @cached_property
    def _file(self) -> IO[bytes]:
        return tempfile.TemporaryFile()

    def put(self) -> None:
        """Compress a block, write it in place of the one before, and force it to the disk."""
        os.pwrite(self._file.fileno(), zlib.compress(self._block), 0)
        os.fsync(self._file.fileno())


class StoringPlanner(FigurePlanner):
    """Stores a block as each plan: in the background, and preempted by the executor."""

    storage = Storage()

    def plan(self, tick: int) -> None:
        """Report, then store."""
        self.output.made_at = tick
        self.storage.put()


class StoringExecutor(FigureExecutor):
    """Stores a block in every cycle, as no executor should."""

    storage = Storage()

    def process(self, tick: int) -> None:
        """Compute, then store."""
        super().process(tick)
        self.storage.put()
