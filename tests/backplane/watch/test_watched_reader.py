"""Readers opened for a task: the kind for each mailbox, and reading on a grid."""

from __future__ import annotations

from rack.backplane.layout import TickGrid
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.watch.watched_reader import (
    GridReader,
    WatchedReader,
    open_watched,
)
from rack.backplane.words import Block
from tests.backplane.bus import NAME
from tests.link import Link, MakeLink


class Grid:
    """A reading task that reads on a grid."""

    def __init__(self, rack: Link, every: int, phase: int) -> None:
        self._rack = rack
        ports = rack.reader.ports
        found = open_watched(rack.segment, NAME, AlarmWriter(rack.segment, "reader"), ports.task)
        assert isinstance(found, WatchedReader)
        self.watched = found
        self.reader = GridReader(found, TickGrid(every, phase))

    def read(self, tick: int) -> tuple[str, bool, int]:
        """Return verdict, loss, and what the message holds."""
        reading = self.reader.read(tick)
        return reading.verdict.name, reading.is_lost, reading.message.id


def test_the_last_reading_is_repeated_between_grid_ticks(link: MakeLink) -> None:
    rack = link()
    grid = Grid(rack, every=3, phase=1)
    assert grid.read(0)[:2] == ("NONE", False)
    seen = []
    for tick in range(8):
        rack.writer.cycle(tick)
        accesses = grid.watched.reader.accesses
        seen.append((*grid.read(tick), grid.watched.reader.accesses - accesses))
    # Read at ticks 1, 4 and 7: what was written a tick before.
    assert seen == [
        ("NONE", False, 0, 0),
        ("NEW", False, 0, 1),
        ("OLD", False, 0, 0),
        ("OLD", False, 0, 0),
        ("NEW", False, 3, 1),
        ("OLD", False, 3, 0),
        ("OLD", False, 3, 0),
        ("NEW", False, 6, 1),
    ]


def test_a_lost_writer_is_reported_between_grid_ticks(link: MakeLink) -> None:
    rack = link()
    grid = Grid(rack, every=4, phase=0)
    for tick in range(9):
        rack.writer.cycle(tick)
        grid.read(tick)
    block = rack.segment.get_block("writer")
    block[Block.LOST] = 10
    assert [grid.read(tick)[1] for tick in (9, 10, 11, 12)] == [False, True, True, True]
    block[Block.LOST] = 0
    # The last reading stands until the next one.
    assert [grid.read(tick)[1] for tick in (13, 15)] == [True, True]
    rack.writer.cycle(15)
    assert grid.read(16)[1] is False
