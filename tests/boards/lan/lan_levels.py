"""Levels for tests of the network: one that counts its cycles, and some that read what other racks
export."""

from __future__ import annotations

from rack.backplane.message import Field, status
from rack.levels.level import Executor, Input, Ports

PULSE = status("pulse", 1, Field("count", "i8", "1", "cycles so far"))
HEARD = status(
    "heard",
    1,
    Field("count", "i8", "1", "count last heard"),
    Field("total", "i8", "1", "sum of all counts heard"),
    Field("lost", "i8", "1", "cycles in which the other rack's writer was lost"),
    Field("backward", "i8", "1", "how often a new count was not above the one before it"),
)


class Pulse(Executor):
    """Counts its cycles."""

    outputs = {"status": PULSE}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        write.status.count = tick // self.context.every


class Echo(Executor):
    """Adds up what it hears of another rack, `lan.other`."""

    inputs = {"other": Input(PULSE, "lan.other")}
    outputs = {"status": HEARD}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Add what is new, and count the cycles in which the writer is lost."""
        other = read.other
        if other.is_new:
            write.status.backward += (
                other.value.count <= write.status.count and write.status.total > 0
            )
            write.status.count = other.value.count
            write.status.total += other.value.count
        write.status.lost += other.is_lost
