"""The hog: a process of its own that takes a board's core away from it, at a higher priority."""

from __future__ import annotations

import time

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import Entry, FaultEntry, FaultTable, Stage
from rack.backplane.process import pin, set_priority
from rack.backplane.segment import Segment
from rack.backplane.words import Block

LEAST_S = 0.001
"""Least time between two such looks."""
LOOK_S = 0.05
"""Least often that a hog which waits for its tick looks whether it is still wanted."""


def run_hog(segment: Segment, entry: FaultEntry) -> None:
    """Wait until the clock begins the fault, then keep the core of its board busy until the fault is over.

    To be called in a process of its own. Raises `PermissionError` where real-time priorities are refused: an ordinary
    process takes no core from anybody.
    """
    task = segment.layout.tasks[entry[Entry.TASK]]
    block, clock = segment.block(task.name), SystemClock(segment)
    pin(block[Block.CORE])
    if not set_priority(min(99, block[Block.PRIORITY] + 1)):
        raise PermissionError(f"hog: SCHED_FIFO priority {block[Block.PRIORITY] + 1} is refused")
    while entry.stage == Stage.WAITING and not clock.is_stopped:
        wait_ns = clock.time_of(max(entry[Entry.FROM], clock.tick + 1)) - time.monotonic_ns()
        # On the clock's grid: the first tick at which the fault can begin, or the next one. Where that has passed
        # already, and before the start, the clock is waited for: at this priority nobody else would get to run.
        time.sleep(min(wait_ns * 1e-9 if wait_ns > 0 else LEAST_S, LOOK_S))
    end = clock.time_of(entry[Entry.UNTIL])
    entry.acted(clock.now(), time.monotonic_ns())
    while time.monotonic_ns() < end and not clock.is_stopped:
        pass
    set_priority(0)


def hog(segment: Segment, index: int) -> int:
    """Run the hog of an entry of the fault table, in a process that the crate has forked; return its exit status."""
    run_hog(segment, FaultTable(segment).entries[index])
    return 0
