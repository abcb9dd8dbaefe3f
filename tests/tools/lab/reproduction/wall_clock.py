"""A level that breaks determinism: what it writes depends on when it ran."""

from __future__ import annotations

from time import monotonic_ns

from rack.backplane.message import Field, status
from rack.levels.level import Executor, Ports

STAMPED_STATUS = status("stamped_status", 1, Field("read_ns", "i8", "ns", "the wall clock"))


class WallClock(Executor):
    """Reports the wall clock."""

    outputs = {"status": STAMPED_STATUS}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Read the clock, as no level may."""
        write.status.read_ns = monotonic_ns()
