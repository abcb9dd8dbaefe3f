"""How the boards of a rack get processors: the keys of `[clock]` that concern all of them."""

from __future__ import annotations

from typing import Literal

from rack.levels.tables import Table

Scheduler = Literal["fixed-priority", "earliest-deadline-first"]
OnNoRealtime = Literal["refuse", "warn"]
RESERVED = 2
"""Times its budget that a board may use up in a cycle: budgets are 99th percentiles, and the kernel
lets whoever uses more wait for the next cycle."""


class Scheduling(Table):
    """Which scheduling boards ask for, and what happens if it is refused."""

    scheduler: Scheduler = "fixed-priority"
    """fixed-priority: SCHED_FIFO, by the boards' priority; earliest-deadline-first: in real time
    SCHED_DEADLINE, by their cycles, with twice their budgets reserved; on any core where the kernel
    refuses theirs"""
    on_no_realtime: OnNoRealtime = "warn"
    """if a SCHED_FIFO priority is refused: warn and continue, or refuse to launch"""
