"""The barest board in Python: a process that does nothing but sleep to the points of a grid."""

from __future__ import annotations

import multiprocessing
import os
import time
from typing import Any

import numpy as np

from rack.backplane.memory import lock_memory
from rack.backplane.process import die_with_parent, pin, set_priority
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.cyclictest import WakeGrid

HEAD_START_NS = 50_000_000


def sleep_loop(grid: WakeGrid) -> np.ndarray:
    """Return the lateness of every wake, us, shape (n,). Raises `Failure` if the process does not
    finish.

    `time.sleep` is `clock_nanosleep` until a point of CLOCK_MONOTONIC. Like a board that is late,
    it skips the points that have passed.
    """
    spawn = multiprocessing.get_context("spawn")
    late_ns = spawn.RawArray("q", [-1] * grid.wakes)
    process = spawn.Process(target=_sleep, args=(os.getpid(), grid, late_ns), daemon=True)
    process.start()
    try:
        process.join(grid.patience_s)
        if process.exitcode:
            raise Failure(f"the loop of clock_nanosleep ended: exit status {process.exitcode}")
    finally:
        process.kill()
        process.join()
    found = np.array(late_ns)
    return found[found >= 0] * 1e-3


def _sleep(parent: int, grid: WakeGrid, late_ns: Any) -> None:
    die_with_parent(parent)
    pin(grid.cores[0])
    set_priority(grid.priority)
    lock_memory()
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
