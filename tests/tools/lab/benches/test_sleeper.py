"""The bare loop of clock_nanosleep: a process of its own that wakes on the grid."""

from __future__ import annotations

import os

from rack.tools.lab.benches.cyclictest import WakeGrid, permits_fifo
from rack.tools.lab.benches.sleeper import sleep_loop


def test_it_wakes_after_every_point_that_it_does_not_skip() -> None:
    grid = WakeGrid((min(os.sched_getaffinity(0)),), 2_000_000, 100, 80 if permits_fifo() else 0)
    found = sleep_loop(grid)
    assert 0 < len(found) <= grid.wakes
    assert (found >= 0).all()
