"""What boards cost by their number: empty ones that pass a message down a chain.

A message that is sent in one cycle is visible to the next board one cycle later, so n boards take
exactly n cycles, however fast or slow they are. Cost is processor time, from the trace, in real
time; in lockstep, where a tick takes as long as its boards do, it is the time of the run.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rack.boards.config import loads
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.chain import LONGEST, PRIORITY, Chain
from rack.tools.lab.benches.chain_figures import RATE_HZ, Boards, ChainFigures
from rack.tools.lab.benches.checkout import RackCommand, rack_commands
from rack.tools.lab.benches.cyclictest import (
    CYCLICTEST,
    WakeGrid,
    absent_cyclictest,
    cyclictest,
    overdue,
)
from rack.tools.lab.benches.harness import interleaved
from rack.tools.lab.benches.observed import Observed, Runs, missed_share, observe

COUNTS = (1, 2, 5, 10, 15, LONGEST)
LAUNCH_S = 1.5
BOUND_S = 120.0
"""Longest time that one run in lockstep may take."""
STRETCH = 10
"""A short chain runs longer in lockstep, at most so many times: else its start would be a part of
its cost."""


def measure(counts: Sequence[int], runs: Runs, against: Path | None, progress: Progress) -> Boards:
    """Run chains of so many boards, by turns with `cyclictest` and in lockstep.

    `against` is another checkout, which runs the same in lockstep. Raises `Failure` if it cannot.
    """
    absent = absent_cyclictest()
    racks = rack_commands(against)
    contestants = 1 + len(racks) + (not absent)
    each_s = runs.rounds * contestants * (runs.seconds + LAUNCH_S)
    progress.total(each_s * len(counts))
    chains = []
    with TemporaryDirectory(prefix="rack-bench-") as folder:
        bench = ChainRuns(runs, racks, Path(folder), is_compared=not absent)
        for count in counts:
            progress.begin(f"boards: {count}")
            chains.append(bench.figures(Chain(count, RATE_HZ)))
            progress.end(each_s)
    trees = tuple(rack.name for rack in racks)
    return Boards(tuple(chains), trees, len(os.sched_getaffinity(0)), absent)


class ChainRuns(NamedTuple):
    """How chains run: `racks` in lockstep, with their configs in `folder`, and next to `cyclictest`
    if so."""

    runs: Runs
    racks: Sequence[RackCommand]
    folder: Path
    is_compared: bool

    def figures(self, chain: Chain) -> ChainFigures:
        """Run every contestant once a round; return the figures of all.

        The response in lockstep is that of one more run.
        """
        in_lockstep = chain._replace(mode="lockstep")
        path = in_lockstep.write(self.folder)
        grid = WakeGrid.at(os.sched_getaffinity(0), RATE_HZ, self.runs.seconds, PRIORITY)
        contestants: dict[str, Callable[[], Any]] = {"chain": partial(self._observe, chain)}
        if self.is_compared:
            contestants[CYCLICTEST] = partial(cyclictest, grid)
        for rack in self.racks:
            contestants[f"lockstep, {rack.name}"] = partial(self._tick_us, rack, chain, path)
        found = interleaved(contestants, self.runs.rounds)
        runs: list[Observed] = found["chain"]
        last = _last(chain)
        counts = [run.cycles(name) for run in runs for name in chain.names]
        rows = [np.concatenate([run.traces[name] for run in runs]) for name in chain.names]
        costs_ns = [float(np.median(trace["processor_ns"])) for trace in rows if len(trace)]
        return ChainFigures(
            boards=chain.boards,
            cycles=sum(count.due for count in counts),
            processor_us=sum(costs_ns) * 1e-3,
            missed=missed_share(counts),
            late=overdue(found.get(CYCLICTEST, ()), grid.period_ns),
            responses=responses_of([run.messages[last] for run in runs]),
            lockstep_responses=responses_of([self._observe(in_lockstep).messages[last]]),
            lockstep_us={
                rack.name: float(np.median(found[f"lockstep, {rack.name}"])) for rack in self.racks
            },
        )

    def _observe(self, chain: Chain) -> Observed:
        return observe(loads(chain.text()), self.runs.seconds, self.runs.share, [_last(chain)])

    def _tick_us(self, rack: RackCommand, chain: Chain, path: Path) -> float:
        """Return the time of a tick in lockstep, us."""
        seconds = self.runs.seconds * min(STRETCH, LONGEST / chain.boards)
        share = ["--share"] * self.runs.share
        return rack.tick_us(path, "--seconds", seconds, *share, bound_s=BOUND_S)


def _last(chain: Chain) -> str:
    """Return the mailbox at the end of a chain."""
    return f"{chain.names[-1]}.status"


def responses_of(runs: Sequence[np.ndarray]) -> dict[int, int]:
    """Return how many messages took how many cycles to the end of the chain; one that a miss
    repeats counts once."""
    counts: Counter[int] = Counter()
    for rows in runs:
        sent, first = np.unique(rows["message"]["sent"], return_index=True)
        took = rows["visible_at"][first] - sent
        counts.update(took[sent >= 0].tolist())
    return dict(sorted(counts.items()))
