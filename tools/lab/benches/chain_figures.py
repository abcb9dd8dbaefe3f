"""The figures of chains of boards: what each costs, whether it holds, and the straight line through
their costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rack.tools.console.tables import table
from rack.tools.lab.benches.chart import Diagram, Series, draw
from rack.tools.lab.benches.cyclictest import BEYOND, MissesBeyond, missed_by, misses_count
from rack.tools.lab.benches.harness import Absent, BenchResult

RATE_HZ = 400


@dataclass(frozen=True)
class Fit:
    """A straight line through costs by number of boards: us a tick; `r2` is 1 where it explains all
    of them."""

    base_us: float
    board_us: float
    r2: float

    @classmethod
    def of(cls, counts: Sequence[int], costs_us: Sequence[float]) -> Fit | None:
        """Return the line of least squares; None for fewer than three numbers of boards."""
        if len(counts) < 3:
            return None
        slope, base = np.polyfit(counts, costs_us, 1)
        r = np.corrcoef(counts, costs_us)[0, 1]
        return cls(float(base), float(slope), float(r * r))

    @property
    def words(self) -> str:
        """The line in words."""
        return f"{self.board_us:.1f} us a board plus {self.base_us:.1f} us (R2 {self.r2:.4f})"


@dataclass(frozen=True)
class ChainFigures(MissesBeyond):
    """All runs of one chain. Costs are us a tick, of all boards; responses are counts of messages
    by cycles."""

    DERIVED = ("beyond", "held", "exact")

    boards: int
    cycles: int
    processor_us: float
    missed: float  # share of all cycles missed or skipped
    late: float | None  # share of cyclictest's wakes that were late by a cycle; None: it is absent
    responses: dict[int, int]
    lockstep_responses: dict[int, int]
    lockstep_us: dict[str, float]  # by tree; median of the runs

    @property
    def exact(self) -> bool:
        """Whether every message took one cycle a board: in lockstep always, in real time if no
        cycle was missed."""
        took = {*self.responses}
        least = self.boards
        if {*self.lockstep_responses} != {least}:
            return False
        return min(took) >= least if self.missed else took == {least}


@dataclass(frozen=True)
class Boards(BenchResult):
    """The figures of every chain, the shortest first; `trees` are those measured in lockstep, this
    one first."""

    name = "boards"
    DERIVED = ("fit", "lockstep_fit")

    chains: tuple[ChainFigures, ...]
    trees: tuple[str, ...]
    cores: int
    absent: tuple[Absent, ...]
    rate_hz: int = RATE_HZ
    permitted_beyond: float = BEYOND

    @property
    def counts(self) -> list[int]:
        """Boards of each chain."""
        return [one.boards for one in self.chains]

    @property
    def exact(self) -> bool:
        """Whether every message of every chain took as many cycles as it should."""
        return all(one.exact for one in self.chains)

    @property
    def fit(self) -> Fit | None:
        """Processor time in real time, by number of boards."""
        return Fit.of(self.counts, [one.processor_us for one in self.chains])

    @property
    def lockstep_fit(self) -> dict[str, Fit | None]:
        """Time of a tick in lockstep, by number of boards, of each tree."""
        return {
            tree: Fit.of(self.counts, [one.lockstep_us[tree] for one in self.chains])
            for tree in self.trees
        }

    @property
    def title(self) -> str:
        """What was measured, in a line."""
        return f"empty boards in a chain at {RATE_HZ} Hz on {self.cores} cores"

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as a table for people, fitted to `width`, and the fits."""
        yield f"{self.title}; costs in us a tick, missed and late in %"
        head = [
            "boards",
            "processor",
            "a board",
            "missed",
            "cyclictest late",
            "beyond",
            "",
            "response, cycles",
        ]
        head += [f"lockstep, {tree}" for tree in self.trees]
        head += ["ratio"] if len(self.trees) > 1 else []
        yield from table(
            head, [self._row(one) for one in self.chains], width, ("a board", "beyond")
        )
        yield from misses_count(self.absent)
        if fit := self.fit:
            yield f"processor time: {fit.words}"
        for tree, fit in self.lockstep_fit.items():
            if fit:
                yield f"lockstep, {tree}: {fit.words}"

    def _row(self, one: ChainFigures) -> list[str]:
        cycles = ", ".join(map(str, sorted({*one.responses, *one.lockstep_responses})))
        if not one.exact:
            cycles += " INEXACT"
        held = "held" if one.held else "not held"
        costs = [one.lockstep_us[tree] for tree in self.trees]
        ratio = [f"{costs[0] / costs[1]:.2f}"] if len(costs) > 1 else []
        return [
            f"{one.boards}",
            f"{one.processor_us:.1f}",
            f"{one.processor_us / one.boards:.1f}",
            *one.cells(),
            held,
            cycles,
            *(f"{cost:.1f}" for cost in costs),
            *ratio,
        ]

    def plot(self, folder: Path) -> list[Path]:
        """Write costs and misses by number of boards into `folder`; return the paths."""
        counts = self.counts
        costs = [*_fitted("processor", counts, [one.processor_us for one in self.chains])]
        for tree in self.trees:
            found = [one.lockstep_us[tree] for one in self.chains]
            costs += _fitted(f"lockstep, {tree}", counts, found)
        panels = (
            Diagram("boards", costs, "us a tick", is_linear=True),
            Diagram("boards", missed_by(counts, self.chains), "% of the cycles"),
        )
        return draw(folder / "boards", self.title, panels)


def _fitted(label: str, counts: Sequence[int], costs_us: Sequence[float]) -> Iterator[Series]:
    """Yield costs by number of boards, and the line through them."""
    yield Series(label, counts, costs_us)
    if fit := Fit.of(counts, costs_us):
        ends = [0, counts[-1]]
        yield Series(fit.words, ends, [fit.base_us + fit.board_us * end for end in ends], "-")
