"""Levels for tests of the network: one that counts its cycles, and some that read what other racks
export."""

from __future__ import annotations

from rack.backplane.message import Status, field
from rack.levels.level import Executor, Input, Output


class PulseStatus(Status, version=1, message="pulse"):
    """Count of cycles."""

    count: int = field(unit="1", doc="cycles so far")


class Heard(Status, version=1):
    count: int = field(unit="1", doc="count last heard")
    total: int = field(unit="1", doc="sum of all counts heard")
    lost: int = field(unit="1", doc="cycles in which the other rack's writer was lost")
    backward: int = field(unit="1", doc="how often a new count was not above the one before it")


class Pulse(Executor):
    status = Output(PulseStatus)

    def process(self, tick: int) -> None:
        self.status.count = tick // self.context.every


class Echo(Executor):
    """Adds up what it hears of another rack, `lan.other`."""

    other = Input(PulseStatus, "lan.other")
    status = Output(Heard)

    def process(self, tick: int) -> None:
        """Add what is new, and count the cycles in which the writer is lost."""
        other = self.other
        if other.is_new:
            self.status.backward += (
                other.message.count <= self.status.count and self.status.total > 0
            )
            self.status.count = other.message.count
            self.status.total += other.message.count
        self.status.lost += other.is_lost
