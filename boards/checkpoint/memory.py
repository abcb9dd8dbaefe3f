"""What of a segment is in a checkpoint: all that somebody can still read, and that is not of one
launch alone.

- System: the tick, demand, latch, utility lines, counts. Not the grid in real time, stop requests,
  recorder, holds, processes.
- The tables of faults and of operators' commands, whole, and the alarm rings.
- Each task: its control block, but for process, core and priority; the newest of its trace.
- Each mailbox: its head, but for its writer's process; the messages that its slowest reader has not
  seen, and those that a read may step back to. Of queues, and of what operators send, all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rack.backplane.address_map import (
    ALARM_SIZE,
    BLOCK_SIZE,
    CLOCK,
    MAILBOX_HEAD_SIZE,
    TRACE_RECORD_SIZE,
    slot_stride,
)
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.mailbox import MAX_STEP_BACK
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Box, System

TRACES = 16
"""Newest records of a task's trace that a reader of its messages may still look at."""
OF_LAUNCH = (
    *(System.STATE, System.EPOCH_NS, System.PERIOD_NS, System.LOCKSTEP, System.STOP_REQUEST),
    *(System.STOP_TICK, System.FOLLOWER_PID, System.TICK_NS, System.CLOCK_PID, System.HOLD_AT),
    System.HELD,
)
OF_PROCESS = (Block.PID, Block.STATE, Block.PRIORITY, Block.CORE, Block.SAVE)
OF_WRITER = (Box.WRITER_PID, Box.CLAIM, Box.OWNER, Box.CLAIMANT)


def regions(segment: Segment, tick: int) -> tuple[tuple[int, int], ...]:
    """Return address and size of each part of the segment that a checkpoint before `tick` holds."""
    return tuple(_regions(segment, tick))


def _regions(segment: Segment, tick: int) -> Iterator[tuple[int, int]]:
    layout = segment.layout
    places = segment.map
    yield 8 * System.STATE, 8 * (System.SYSFAIL - System.STATE)
    yield places.faults, places.alarms[CLOCK] + ALARM_SIZE - places.faults
    for task in layout.processes:
        yield places.blocks[task.name], BLOCK_SIZE
        yield places.alarms[task.name], ALARM_SIZE
        ring = places.traces[task.name], TRACE_RECORD_SIZE, task.depth
        yield from _newest(ring, segment.block(task.name)[Block.TRACE_HEAD], TRACES)
    for box in layout.mailboxes:
        address = places.mailboxes[box.name]
        yield address, MAILBOX_HEAD_SIZE
        ring = address + MAILBOX_HEAD_SIZE, slot_stride(box), box.depth
        yield from _newest(ring, segment.box(box.name)[Box.HEAD], _readable(segment, box, tick))


def _readable(segment: Segment, box: MailboxSpec, tick: int) -> int:
    """Return how many messages of a mailbox somebody may still read."""
    if box.capacity or box.writer == CLOCK:
        return box.depth
    # Each has read it in its newest release; one with an exchange at the last tick of its grid.
    longest = max([tick - segment.block(name)[Block.RELEASED] for name in box.readers], default=0)
    grid = max([exchange.every for exchange in box.exchanges], default=0)
    return (longest + grid + box.delay) // box.every + 2 + MAX_STEP_BACK


def _newest(ring: tuple[int, int, int], head: int, count: int) -> Iterator[tuple[int, int]]:
    """Yield the places of the newest records of a ring, given as address, size of a record, and
    records; as few pieces as there are."""
    address, size, depth = ring
    count = min(count, depth, head)
    if not count:
        # A host board's trace has no depth.
        return
    first = (head - count + 1) % depth
    before_wrap = min(count, depth - first)
    yield address + first * size, before_wrap * size
    if count > before_wrap:
        yield address, (count - before_wrap) * size


def copy(segment: Segment, places: tuple[tuple[int, int], ...]) -> bytes:
    """Return the contents of regions."""
    return b"".join(segment.view(address, size) for address, size in places)


def fill(segment: Segment, tick: int, places: tuple[tuple[int, int], ...], memory: bytes) -> None:
    """Fill the segment of a rack that is being launched, to continue before `tick`."""
    own: list[tuple[memoryview[int], Sequence[int]]] = [(segment.words, OF_LAUNCH)]
    own += [(segment.block(task.name), OF_PROCESS) for task in segment.layout.processes]
    own += [(segment.box(box.name), OF_WRITER) for box in segment.layout.mailboxes]
    kept = [[words[at] for at in which] for words, which in own]
    taken = 0
    for address, size in places:
        segment.view(address, size)[:] = memory[taken : taken + size]
        taken += size
    for (words, which), values in zip(own, kept, strict=True):
        for at, value in zip(which, values, strict=True):
            words[at] = value
    # A recorder finds what this run writes, and nothing before it.
    segment.words[System.FOLLOWER_TICK] = segment.words[System.FOLLOWER_DRAINED] = tick - 1
    for task in segment.layout.processes:
        block = segment.block(task.name)
        block[Block.TRACE_FIRST] = block[Block.TRACE_HEAD]
    for box in segment.layout.mailboxes:
        words = segment.box(box.name)
        words[Box.FIRST] = words[Box.HEAD]
