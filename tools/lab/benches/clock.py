"""How late a board's cycle starts after its grid point, next to other programs that sleep to a grid
on that core.

A board that sleeps and `cyclictest` are measured both ways: idle cores may sleep, and are held
awake. The bench itself holds them awake, which is the same for both: the request is one to the
system.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import NamedTuple, get_args

import numpy as np

from rack.backplane.layout import Wake
from rack.backplane.process import cores_kept_awake
from rack.boards.config import loads
from rack.levels.timing.trace_times import lateness_ns, skipped
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.chain import PRIORITY, Chain
from rack.tools.lab.benches.cyclictest import (
    CYCLICTEST,
    WakeGrid,
    absent_cyclictest,
    cyclictest,
    permits_fifo,
)
from rack.tools.lab.benches.harness import Absent, Comparison, Sample, interleaved, shown
from rack.tools.lab.benches.observed import SETTLE_NS, Runs, observe
from rack.tools.lab.benches.sleeper import sleep_loop

RATES_HZ = (50, 400, 1000, 2000)
BARE = "clock_nanosleep, Python"
BOTH_WAYS = "board, timer", CYCLICTEST
AWAKE = ", cores awake"
"""Ends the names of those that are measured while idle cores are held awake."""
LAUNCH_S = 1.5
"""About how long starting and ending a contestant take."""
Contestants = dict[str, Callable[[WakeGrid], np.ndarray]]


def measure(rates_hz: Sequence[float], runs: Runs, progress: Progress) -> Comparison:
    """Return the lateness of every contestant at each rate, us."""
    contestants, absent = _contestants(runs.share)
    core = max(os.sched_getaffinity(0))
    is_fifo = permits_fifo()
    priority = PRIORITY if is_fifo else 0
    cost_s = (runs.seconds + LAUNCH_S) * runs.rounds * len(contestants)
    progress.total(cost_s * len(rates_hz))
    samples = []
    for rate_hz in rates_hz:
        progress.begin(f"{rate_hz:g} Hz")
        grid = WakeGrid.at((core,), rate_hz, runs.seconds, priority)
        turns = {who: partial(_attempt, who, one, grid) for who, one in contestants.items()}
        for who, found in interleaved(turns, runs.rounds).items():
            reasons = [late for late in found if isinstance(late, str)]
            late_us = np.concatenate([[], *(late for late in found if not isinstance(late, str))])
            if len(late_us):
                samples.append(Sample(f"{rate_hz:g} Hz", who, tuple(late_us.tolist()), "us"))
            if reasons:
                absent.append(
                    Absent(
                        f"{who} at {rate_hz:g} Hz, {len(reasons)} of {runs.rounds} rounds",
                        reasons[0],
                    )
                )
        progress.end(cost_s)
    refused = "" if is_fifo else "; SCHED_FIFO is refused, so all run under ordinary scheduling"
    title = f"lateness: from grid point to start, on core {core}{refused}"
    baselines = {f"{rate:g} Hz": CYCLICTEST for rate in rates_hz}
    return Comparison("clock", title, tuple(samples), baselines, tuple(absent), suiting(samples))


class IdleCores(NamedTuple):
    """What one setting of `clock.idle_cores` gave: wake-ups `lost`, late by a period, and all
    lateness, us."""

    setting: str
    lost: int
    late_us: np.ndarray

    def __str__(self) -> str:
        late = f"worst {shown(self.late_us.max())} us, median {shown(np.median(self.late_us))} us"
        return (
            f'"{self.setting}", {self.lost} of {len(self.late_us)} wake-ups late by a period,'
            f" {late}"
        )


def suiting(samples: Sequence[Sample]) -> str:
    """Return which `clock.idle_cores` suits this machine, with the figures that say so; empty
    without both ways.

    Lost wake-ups decide if the counts are apart by more than chance, two standard deviations of it;
    if not, the worst wake-up: a core that its host takes away shows there first. The median is only
    the price.
    """
    found = []
    for setting, ending in (("sleep", ""), ("awake", AWAKE)):
        own = [one for one in samples if one.who in [who + ending for who in BOTH_WAYS]]
        if not own:
            return ""
        lost = sum(us >= 1e6 / float(one.case.split()[0]) for one in own for us in one.values)
        found.append(IdleCores(setting, lost, np.concatenate([one.values for one in own])))
    asleep, awake = found
    is_apart = abs(asleep.lost - awake.lost) > 2.0 * math.sqrt(asleep.lost + awake.lost)
    best, other = sorted(found, key=lambda one: one.lost if is_apart else one.late_us.max())
    return f"clock.idle_cores that suits this machine: {best}; with {other}"


def _attempt(
    who: str, contestant: Callable[[WakeGrid], np.ndarray], grid: WakeGrid
) -> np.ndarray | str:
    """Return a contestant's lateness, or why it did not run."""
    try:
        kept = cores_kept_awake() if who.endswith(AWAKE) else nullcontext("")
        with kept as refusal:
            return refusal or contestant(grid)
    except Failure as failure:
        return str(failure)


def _contestants(share: bool) -> tuple[Contestants, list[Absent]]:
    """Return who can be measured on this machine, and who not."""
    found: Contestants = {f"board, {wake}": partial(board, wake, share) for wake in get_args(Wake)}
    absent: list[Absent] = []
    if len(os.sched_getaffinity(0)) < 2:
        del found["board, poll"]
        absent.append(
            Absent(
                "board, poll",
                "a board that polls needs a core of its own, and this machine has one",
            )
        )
    found[BARE] = sleep_loop
    missing = absent_cyclictest()
    absent += missing
    if not missing:
        found[CYCLICTEST] = cyclictest
    found |= {who + AWAKE: found[who] for who in BOTH_WAYS if who in found}
    return found, absent


def board(wake: Wake, share: bool, grid: WakeGrid) -> np.ndarray:
    """Return the lateness of an empty board's cycles, us, shape (n,): from its trace.

    After skipped releases it counts from the first of them, as that of any program that has
    overslept grid points.
    """
    chain = Chain(1, round(1e9 / grid.period_ns), wake=wake)
    seconds = (grid.wakes * grid.period_ns + SETTLE_NS) * 1e-9
    rows = observe(loads(chain.text()), seconds, share).settled(chain.names[0])
    return np.asarray(lateness_ns(rows) + skipped(rows) * grid.period_ns) * 1e-3
