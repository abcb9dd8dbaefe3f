"""The barest board in Python: a process that does nothing but sleep to the points of a grid."""

from __future__ import annotations

import time

import numpy as np

from rack.backplane.memory import hold_memory
from rack.backplane.process import pin, set_priority
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.cyclictest import WakeGrid

HEAD_START_NS = 50_000_000


def sleep_loop(grid: WakeGrid) -> np.ndarray:
    """Return the lateness of every wake, us, shape (n,). Raises `Failure`.

    `time.sleep` is `clock_nanosleep` until a point of CLOCK_MONOTONIC. Like a board that is late,
    it skips the points that have passed.
    """
    found = np.array(apart(measure, grid))
    return found[found >= 0] * 1e-3


def measure(grid: WakeGrid) -> list[int]:
    """Sleep to every point, in a process of its own; return how late, ns; -1: skipped."""
    pin(grid.cores[0])
    set_priority(grid.priority)
    hold_memory()
    late_ns = [-1] * grid.wakes
    period = grid.period_ns
    monotonic_ns = time.monotonic_ns
    sleep = time.sleep
    epoch = monotonic_ns() + HEAD_START_NS
    at = 0
    while at < grid.wakes:
        due = epoch + at * period
        if (left := due - monotonic_ns()) > 0:
            sleep(left * 1e-9)
        late = monotonic_ns() - due
        late_ns[at] = late
        at += 1 + max(late, 0) // period
    return late_ns
