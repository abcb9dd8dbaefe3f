"""Trace rings: one fixed record for each cycle of a task, written without ever waiting.

One record gives the lateness (start - release), t_comm (read and write parts), t_exec (the process
part) and t_residual (deadline - end) of eq. 3.5, t_executor-planner of eq. 3.9 (plan - start), and
the processor time of the cycle, without preemption. A reader that falls behind knows how many
records it lost.

A task writes the record of a cycle after the cycle's last message. The trace therefore also proves
facts about messages (`CycleRecord`): a message that is missing when the record is there was not
written, and a message that appears later was held back. The age of a message alone proves nothing,
because the task may have been preempted.
"""

from __future__ import annotations

from enum import IntFlag
from struct import Struct

import numpy as np

from rack.backplane.address_map import TRACE_RECORD_SIZE, compute_oldest_intact
from rack.backplane.ring import Ring
from rack.backplane.segment import Segment
from rack.backplane.words import Block

FIELDS = (
    "tick",  # release, in ticks
    "release_ns",  # the grid point of that tick, CLOCK_MONOTONIC
    "start_ns",
    # The executor has read its plan over the bus (C of fig. 4). start_ns without a plan.
    "plan_ns",
    "read_ns",  # command, status and plan read
    "process_ns",  # process done
    "end_ns",  # command and status written
    # Flag in the low 16 bits. The upper bits are the number of releases skipped just before.
    "flags",
    "state",  # state of the level
    # Processor time of the thread since the last record: this cycle and its wake-up.
    "processor_ns",
    "closed_ns",  # end of the bookkeeping of the previous cycle, 0 in the first
)
RECORD = np.dtype([(name, "i8") for name in FIELDS])
SKIPPED_SHIFT = 16


class Flag(IntFlag):
    """Flags of a cycle's record."""

    MISSED = 1  # missed its deadline, or wrote a message too late
    SKIPPED = 2  # releases were skipped just before it
    BUS_ERROR = 4  # an access timed out
    CORRUPT = 8  # the checksum of a message was wrong
    PLANNED = 16  # the record of a planner's cycle that made a plan


# Plain integers for the hot path.
_TICK, _END, _FLAGS = (FIELDS.index(name) for name in ("tick", "end_ns", "flags"))
_RECORD = TRACE_RECORD_SIZE // 8
# Native alignment: each number is stored whole.
_PACK = Struct(f"@{len(FIELDS)}q").pack_into
_BUS_ERROR = int(Flag.BUS_ERROR)


class TraceWriter:
    """Writing end of a task's trace ring."""

    def __init__(self, segment: Segment, task: str) -> None:
        spec = segment.layout.find_task(task)
        self._block = segment.get_block(task)
        self._ring = segment.get_bytes(segment.map.traces[task], spec.depth * TRACE_RECORD_SIZE)
        self._mask = spec.depth - 1
        self._count = self._block[Block.TRACE_HEAD]

    def write(self, *record: int) -> None:
        """Append a record, given as one number for each field of `RECORD`, in order."""
        self._count = count = self._count + 1
        _PACK(self._ring, (count & self._mask) * TRACE_RECORD_SIZE, *record)
        self._block[Block.TRACE_HEAD] = count


def open_trace_ring(segment: Segment, task: str) -> Ring:
    """Open the reading end of a task's trace ring. Its rows have dtype `RECORD`."""
    depth = segment.layout.find_task(task).depth
    block = segment.get_block(task)
    memory = segment.get_bytes(segment.map.traces[task], depth * TRACE_RECORD_SIZE)
    return Ring(
        memory, RECORD, block[Block.TRACE_HEAD : Block.TRACE_HEAD + 1], block[Block.TRACE_FIRST]
    )


class CycleRecord:
    """Read access to a task's trace, to find which of its cycles have ended and when."""

    def __init__(self, segment: Segment, task: str) -> None:
        self._block = segment.get_block(task)
        self._words = segment.words
        self._first = segment.map.traces[task] // 8
        self._depth = segment.layout.find_task(task).depth

    @property
    def finished_tick(self) -> int:
        """Release tick of the newest traced cycle.

        It is -1 if no cycle was traced, if an access of that cycle timed out, or if its record may
        be partly overwritten.
        """
        count = self._block[Block.TRACE_HEAD]
        at = self._get_index(count)
        flags = self._words[at + _FLAGS]
        tick = self._words[at + _TICK]
        return tick if count and not flags & _BUS_ERROR and self._is_intact(count) else -1

    def find_end_ns(self, tick: int) -> int | None:
        """Return the end of the cycle released at `tick`, in ns of CLOCK_MONOTONIC.

        The result is None if the cycle was not traced, or its record has been overwritten.
        """
        count = self._block[Block.TRACE_HEAD]
        for number in range(count, max(0, count - self._depth), -1):
            at = self._get_index(number)
            record_tick = self._words[at + _TICK]
            ended_ns = self._words[at + _END]
            if not self._is_intact(number) or record_tick < tick:
                return None
            if record_tick == tick:
                return ended_ns
        return None

    def _is_intact(self, number: int) -> bool:
        """Check that the writer has not begun to overwrite the record with this number."""
        return number >= compute_oldest_intact(self._block[Block.TRACE_HEAD], self._depth)

    def _get_index(self, number: int) -> int:
        """Return the index in the segment's words at which the record with this number starts."""
        return self._first + number % self._depth * _RECORD
