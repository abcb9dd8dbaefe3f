"""What boards cost by their number: empty ones that pass a message down a chain.

A message that is sent in one cycle is visible to the next board one cycle later, so n boards take
exactly n cycles, however fast or slow they are. Cost is processor time, from the trace, in real
time; in lockstep, where a tick takes as long as its boards do, it is the time of the run.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rack.boards.config import loads
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.chain import LONGEST, PRIORITY, Chain
from rack.tools.lab.benches.chain_figures import RATE_HZ, Boards, ChainFigures
from rack.tools.lab.benches.checkout import RackCommand, rack_commands
from rack.tools.lab.benches.cyclictest import WakeGrid, absent_cyclictest, cyclictest, overdue
from rack.tools.lab.benches.harness import turns
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
    cores = tuple(sorted(os.sched_getaffinity(0)))
    peers = () if absent else cores
    racks = rack_commands(against)
    with TemporaryDirectory(prefix="rack-bench-") as folder:
        chains = [
            _ChainRuns(Chain(count, RATE_HZ), runs, peers, racks, Path(folder)) for count in counts
        ]
        progress.total(sum(chain.lasts_s for chain in chains))
        for chain in chains:
            progress.begin(f"boards: {chain.chain.boards}")
            chain.measure()
            progress.end(chain.lasts_s)
        return Boards(
            tuple(chain.figures() for chain in chains),
            tuple(rack.name for rack in racks),
            len(cores),
            absent,
        )


class _ChainRuns:
    """All runs of one chain; `peers` are the cores of `cyclictest`, `racks` run in lockstep."""

    def __init__(
        self,
        chain: Chain,
        runs: Runs,
        peers: tuple[int, ...],
        racks: Sequence[RackCommand],
        folder: Path,
    ) -> None:
        self.chain = chain
        self._settings = runs
        self._grid = WakeGrid.at(peers, RATE_HZ, runs.seconds, PRIORITY)
        path = chain._replace(mode="lockstep").write(folder)
        self._runs: list[Observed] = []
        self._late: list[np.ndarray] = []
        self._lockstep_us: dict[str, list[float]] = {rack.name: [] for rack in racks}
        self._contestants: list[Callable[[], None]] = [self._run, *([self._peer] if peers else [])]
        self._contestants += [partial(self._lockstep, rack, path) for rack in racks]

    @property
    def lasts_s(self) -> float:
        """About how long measuring takes."""
        return self._settings.rounds * len(self._contestants) * (self._settings.seconds + LAUNCH_S)

    def measure(self) -> None:
        """Run every contestant once a round."""
        for _, contestant in turns(self._contestants, self._settings.rounds):
            contestant()

    def _run(self) -> None:
        self._runs.append(self._observe(self.chain))

    def _observe(self, chain: Chain) -> Observed:
        return observe(
            loads(chain.text()), self._settings.seconds, self._settings.share, [self._last]
        )

    def _peer(self) -> None:
        self._late.append(cyclictest(self._grid))

    def _lockstep(self, rack: RackCommand, path: Path) -> None:
        seconds = self._settings.seconds * min(STRETCH, LONGEST / self.chain.boards)
        options = ["--lockstep", "--no-record", "--json", "--seconds", seconds]
        options += ["--share"] if self._settings.share else []
        found = json.loads(rack.run("run", path, *options, bound_s=BOUND_S))
        self._lockstep_us[rack.name].append(found["wall_s"] * 1e6 / found["outcome"]["ticks"])

    @property
    def _last(self) -> str:
        return f"{self.chain.names[-1]}.status"

    def figures(self) -> ChainFigures:
        """Return the figures of all runs; the response in lockstep is that of one more."""
        lockstep = self._observe(self.chain._replace(mode="lockstep"))
        names = self.chain.names
        late = np.concatenate(self._late) if self._late else None
        counts = [run.cycles(name) for run in self._runs for name in names]
        rows = [np.concatenate([run.traces[name] for run in self._runs]) for name in names]
        return ChainFigures(
            boards=self.chain.boards,
            cycles=sum(count.due for count in counts),
            processor_us=sum(
                float(np.median(trace["processor_ns"])) for trace in rows if len(trace)
            )
            * 1e-3,
            missed=missed_share(counts),
            late=None if late is None else overdue(late, self._grid.period_ns),
            responses=responses_of([run.messages[self._last] for run in self._runs]),
            lockstep_responses=responses_of([lockstep.messages[self._last]]),
            lockstep_us={
                name: float(np.median(costs)) for name, costs in self._lockstep_us.items()
            },
        )


def responses_of(runs: Sequence[np.ndarray]) -> dict[int, int]:
    """Return how many messages took how many cycles to the end of the chain; one that a miss
    repeats counts once."""
    counts: Counter[int] = Counter()
    for rows in runs:
        sent, first = np.unique(rows["message"]["sent"], return_index=True)
        took = rows["visible_at"][first] - sent
        counts.update(took[sent >= 0].tolist())
    return dict(sorted(counts.items()))
