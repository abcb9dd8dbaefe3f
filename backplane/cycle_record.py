"""What a task's trace proves about its messages: which release it has finished last, and when a cycle ended.

A task traces a cycle after its last write, so a message that is not there by then was not written, and one that
comes later was held back. Age alone proves nothing: the machine may have taken the core away.
"""

from __future__ import annotations

from rack.backplane.address_map import TRACE_RECORD_SIZE, oldest_kept
from rack.backplane.segment import Segment
from rack.backplane.trace import FIELDS, Flag
from rack.backplane.words import Block

# Plain integers for the hot path.
_TICK, _END, _FLAGS = (FIELDS.index(name) for name in ("tick", "end_ns", "flags"))
_RECORD = TRACE_RECORD_SIZE // 8
_TRACE_HEAD, _BUS_ERROR = int(Block.TRACE_HEAD), int(Flag.BUS_ERROR)


class CycleRecord:
    """The trace of one task, as the readers of its mailboxes consult it."""

    def __init__(self, segment: Segment, task: str) -> None:
        self._block = segment.block(task)
        self._words = segment.words
        self._first = segment.map.traces[task] // 8
        self._depth = segment.layout.task(task).depth

    @property
    def finished(self) -> int:
        """Newest release whose cycle has ended with every access done; -1: none, one was cut off, or not known."""
        count = self._block[_TRACE_HEAD]
        at = self._at(count)
        flags, tick = self._words[at + _FLAGS], self._words[at + _TICK]
        return tick if count and not flags & _BUS_ERROR and self._keeps(count) else -1

    def ended_ns(self, tick: int) -> int | None:
        """Return when the cycle released at `tick` ended, CLOCK_MONOTONIC; None when there is no record of it."""
        count = self._block[_TRACE_HEAD]
        for number in range(count, max(0, count - self._depth), -1):
            at = self._at(number)
            found, ended_ns = self._words[at + _TICK], self._words[at + _END]
            if not self._keeps(number) or found < tick:
                return None
            if found == tick:
                return ended_ns
        return None

    def _keeps(self, number: int) -> bool:
        return number >= oldest_kept(self._block[_TRACE_HEAD], self._depth)

    def _at(self, number: int) -> int:
        return self._first + number % self._depth * _RECORD
