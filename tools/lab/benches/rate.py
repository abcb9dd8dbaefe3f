"""The highest servo rate that a rack holds on this machine, by the deadlines that `cyclictest`
keeps there.

Only the servo level changes: the clock follows its rate, and every other board gets the cycle that
is closest to its own. A machine that takes the core away for a cycle breaks deadlines that no
program could keep: what `cyclictest` shows late by a cycle, at that rate on that core in the same
minutes, does not count against the rack.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rack.boards.config import RackConfig, load
from rack.boards.config.layout import obtained_core
from rack.levels.timing.trace_times import Distribution, distribution, lateness_ns
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import figure, table
from rack.tools.lab.benches.chart import Diagram, Series, draw
from rack.tools.lab.benches.cyclictest import (
    BEYOND,
    CYCLICTEST,
    MissesBeyond,
    WakeGrid,
    absent_cyclictest,
    cyclictest,
    missed_by,
    misses_count,
    overdue,
)
from rack.tools.lab.benches.harness import Absent, BenchResult, interleaved
from rack.tools.lab.benches.observed import (
    UNJUDGED,
    Observed,
    Runs,
    endless,
    missed_share,
    observe,
)

RATES_HZ = (400, 500, 800, 1000, 1250, 2000)
STEP_MS = 0.5
"""Longest time step of the simulated arm, that of the bundled racks."""
LAUNCH_S = 3.0


def at_rate(config: RackConfig, rate_hz: float) -> RackConfig:
    """Return a rack whose fastest board cycles at `rate_hz`, at every tick; the others keep their
    cycles, in ms.

    A plan of that board still takes as long. Raises `Failure` for a rack that has no board at every
    tick.
    """
    fastest = [name for name in config.board if config.every(name) == 1]
    if not fastest:
        raise Failure(
            f"rack '{config.name}': no board cycles at every tick of its clock, so none has a rate"
            " to raise"
        )
    period_ms = 1e3 / rate_hz
    scale = config.clock.period_ms / period_ms
    boards = {}
    for name, board in endless(config).board.items():
        changes: dict[str, Any] = {"every": max(1, round(config.every(name) * scale))}
        if name in fastest:
            changes = {"every": 1, "within_cycles": max(1, round(board.within_cycles * scale))}
        boards[name] = board.model_copy(update={**changes, "rate_hz": None})
    robot = config.robot
    if robot is not None:
        # Rounded: 2.5 ms / 0.5 ms must be 5, whatever the last bit says.
        robot = robot.model_copy(update={"substeps": math.ceil(round(period_ms / STEP_MS, 6))})
    clock = config.clock.model_copy(
        update={"period_ms": period_ms, "mode": "realtime", "speed": 1.0}
    )
    return config.model_copy(update={"clock": clock, "board": boards, "robot": robot})


@dataclass(frozen=True)
class RateFigures(MissesBeyond):
    """All runs at one rate. Shares are of the fastest board's cycles; `late` is that of
    `cyclictest`'s wakes."""

    rate_hz: float
    cycles: int
    missed: float  # share missed or skipped
    late: float | None  # share late by a cycle or more; None: cyclictest is absent
    lateness_us: Distribution | None
    processor_us: float  # median of a cycle
    failure: str  # why a run ended early; empty: none did

    @property
    def held(self) -> bool:
        """Whether the rack holds this rate."""
        return not self.failure and super().held

    @property
    def verdict(self) -> str:
        """The same in a word, or why a run failed."""
        if self.failure:
            return self.failure
        return "held" if self.held else "not held"


@dataclass(frozen=True)
class Rates(BenchResult):
    """The figures of every rate, lowest first; `absent` is the peer that this machine lacks."""

    name = "rate"
    DERIVED = ("highest_held_hz",)

    config: str
    board: str
    core: int
    rates: tuple[RateFigures, ...]
    absent: tuple[Absent, ...]
    permitted_beyond: float = BEYOND

    @property
    def highest_held_hz(self) -> float | None:
        """The highest rate that is held; None if none is."""
        return max((one.rate_hz for one in self.rates if one.held), default=None)

    @property
    def title(self) -> str:
        """What was measured, in a line."""
        return f"{self.config}: rate of board '{self.board}' on core {self.core}"

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as a table for people, fitted to `width`, and the highest rate held."""
        yield f"{self.title}; missed and late in % of its cycles"
        head = [
            "rate, Hz",
            "cycles",
            "missed",
            "cyclictest late",
            "beyond",
            "late p50, us",
            "p99",
            "processor, us",
            "",
        ]
        yield from table(
            head, [self._row(one) for one in self.rates], width, ("cycles", "p99", "late p50, us")
        )
        yield from misses_count(self.absent)
        highest = self.highest_held_hz
        bound = f"missed at most {BEYOND:.1%} beyond cyclictest"
        rate = "none of these" if highest is None else f"{highest:g} Hz"
        yield f"highest rate held: {rate} ({bound})"

    @staticmethod
    def _row(one: RateFigures) -> list[str]:
        late_us = [figure(one.lateness_us, name, 0) for name in ("p50", "p99")]
        return [
            f"{one.rate_hz:g}",
            f"{one.cycles}",
            *one.cells(),
            *late_us,
            f"{one.processor_us:.0f}",
            one.verdict,
        ]

    def plot(self, folder: Path) -> list[Path]:
        """Write missed cycles and load by rate into `folder`; return the paths."""
        rates = [one.rate_hz for one in self.rates]
        loads = [one.processor_us * one.rate_hz * 1e-4 for one in self.rates]
        load = [Series("", rates, loads, "o-")]
        panels = (
            Diagram("servo rate, Hz", missed_by(rates, self.rates), "% of the cycles"),
            Diagram("servo rate, Hz", load, "processor time of a cycle, % of its period"),
        )
        return draw(folder / "rate", self.title, panels)


def measure(name: str, rates_hz: Sequence[float], runs: Runs, progress: Progress) -> Rates:
    """Run a rack at every rate, by turns with `cyclictest` on the core of its fastest board."""
    config = load(name, [f"name=bench-{os.getpid()}", UNJUDGED])
    racks = {rate_hz: at_rate(config, rate_hz) for rate_hz in sorted(rates_hz)}
    board = next(name for name in config.board if config.every(name) == 1)
    core = obtained_core(config.board[board].core)
    absent = absent_cyclictest()
    each_s = runs.rounds * (2 * runs.seconds + LAUNCH_S)
    progress.total(len(racks) * each_s)
    figures = []
    for rate_hz, rack in racks.items():
        progress.begin(f"{rate_hz:g} Hz")
        grid = WakeGrid.at((core,), rate_hz, runs.seconds, config.board[board].priority or 1)
        contestants: dict[str, Callable[[], Any]] = {
            "rack": partial(observe, rack, runs.seconds, runs.share)
        }
        if not absent:
            contestants[CYCLICTEST] = partial(cyclictest, grid)
        found = interleaved(contestants, runs.rounds)
        late = overdue(found.get(CYCLICTEST, ()), grid.period_ns)
        figures.append(_figures(rate_hz, board, found["rack"], late))
        progress.end(each_s, figures[-1].verdict)
    return Rates(name, board, core, tuple(figures), absent)


def _figures(
    rate_hz: float, board: str, runs: Sequence[Observed], late: float | None
) -> RateFigures:
    settled = np.concatenate([run.settled(board) for run in runs])
    failure = next(filter(None, (run.outcome.failure for run in runs)), "")
    processor_us = float(np.median(settled["processor_ns"])) * 1e-3 if len(settled) else 0.0
    return RateFigures(
        rate_hz=rate_hz,
        cycles=sum(run.cycles(board).due for run in runs),
        missed=missed_share(run.cycles(board) for run in runs),
        late=late,
        lateness_us=distribution(lateness_ns(settled) * 1e-3),
        processor_us=processor_us,
        failure=failure,
    )
