"""How late a board's cycle starts after its grid point, next to other programs that sleep to a grid on that core."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import get_args

import numpy as np

from rack.backplane.layout import Wake
from rack.boards.config import loads
from rack.levels.timing.trace_times import lateness_ns
from rack.tools.benches.chain import PRIORITY, Chain
from rack.tools.benches.comparison import Absent, Comparison, Sample, interleaved
from rack.tools.benches.cyclictest import CYCLICTEST, WakeGrid, absent_cyclictest, cyclictest, permits_fifo
from rack.tools.benches.linuxcnc import LINUXCNC, absent_linuxcnc, linuxcnc
from rack.tools.benches.observed import SETTLE_NS, Runs, observe
from rack.tools.benches.sleeper import sleep_loop
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress

RATES_HZ = (50, 400, 1000, 2000)
BARE = "clock_nanosleep, Python"
LAUNCH_S = 1.5
"""About how long starting and ending a contestant take."""
Contestants = dict[str, Callable[[WakeGrid], np.ndarray]]


def measure(rates_hz: Sequence[float], runs: Runs, progress: Progress) -> Comparison:
    """Return the lateness of every contestant at each rate, us."""
    contestants, absent = _contestants(runs.share)
    cores, is_fifo = sorted(os.sched_getaffinity(0)), permits_fifo()
    turn_s = runs.seconds + LAUNCH_S
    progress.total(turn_s * runs.rounds * len(rates_hz) * len(contestants))
    samples = []
    for rate_hz in rates_hz:
        progress.begin(f"{rate_hz:g} Hz")
        wakes = max(1, round(runs.seconds * rate_hz))
        grid = WakeGrid((cores[-1],), round(1e9 / rate_hz), wakes, PRIORITY if is_fifo else 0)
        turns = {who: partial(_attempt, one, grid) for who, one in contestants.items()}
        for who, found in interleaved(turns, runs.rounds).items():
            reasons = [late for late in found if isinstance(late, str)]
            late_us = np.concatenate([[], *(late for late in found if not isinstance(late, str))])
            if len(late_us):
                samples.append(Sample(f"{rate_hz:g} Hz", who, tuple(late_us.tolist()), "us"))
            if reasons:
                absent.append(Absent(f"{who} at {rate_hz:g} Hz, {len(reasons)} of {runs.rounds} rounds", reasons[0]))
        progress.end(turn_s * runs.rounds * len(contestants), "done", ())
    refused = "" if is_fifo else "; SCHED_FIFO is refused, so all run under ordinary scheduling"
    own_grid = f"; {LINUXCNC}: after its earliest run" if LINUXCNC in contestants else ""
    title = f"lateness: from grid point to start, on core {cores[-1]}{own_grid}{refused}"
    return Comparison("clock", title, tuple(samples), {f"{rate:g} Hz": CYCLICTEST for rate in rates_hz}, tuple(absent))


def _attempt(contestant: Callable[[WakeGrid], np.ndarray], grid: WakeGrid) -> np.ndarray | str:
    """Return a contestant's lateness, or why it did not run."""
    try:
        return contestant(grid)
    except Failure as failure:
        return str(failure)


def _contestants(share: bool) -> tuple[Contestants, list[Absent]]:
    """Return who can be measured on this machine, and who not."""
    found: Contestants = {f"board, {wake}": partial(board, wake, share) for wake in get_args(Wake)}
    absent = []
    if len(os.sched_getaffinity(0)) < 2:
        del found["board, poll"]
        absent.append(Absent("board, poll", "a board that polls needs a core of its own, and this machine has one"))
    found[BARE] = sleep_loop
    for who, missing, peer in ((CYCLICTEST, absent_cyclictest(), cyclictest), (LINUXCNC, absent_linuxcnc(), linuxcnc)):
        if missing is None:
            found[who] = peer
        else:
            absent.append(missing)
    return found, absent


def board(wake: Wake, share: bool, grid: WakeGrid) -> np.ndarray:
    """Return the lateness of an empty board's cycles, us, shape (n,): from its trace."""
    chain = Chain(1, round(1e9 / grid.period_ns), wake=wake)
    seconds = (grid.wakes * grid.period_ns + SETTLE_NS) * 1e-9
    return lateness_ns(observe(loads(chain.text()), seconds, share).settled(chain.names[0])) * 1e-3
