"""What the benches of `rack bench` share. Each answers one question of a user, which its help says.

A bench is a function `measure(..., progress)` that returns a `Comparison`: a record of what it has
found. `show` calls it, with the progress on the terminal, and prints the record as text or as one
JSON document.

A machine's speed drifts by a factor of two within a day, so no time means much alone. Contestants
are measured by turns (`interleaved`) in an order that changes from round to round, and each is
judged by the ratio of its median to that of the baseline in the same case. A peer that this machine
lacks is `Absent`: it is named, and the others are measured all the same.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from random import Random
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rack.backplane.process import pin, set_priority
from rack.tools.console.answer import Failure, print_json
from rack.tools.console.tables import Blocks, Cell, TextTable, decimal, print_blocks

if TYPE_CHECKING:
    from rack.tools.console.progress import Progress

EXTRA = "pip install 'nasrem-rack[lab]'"
"""Brings the peers that are Python packages."""
END_S = 1.2
"""Longest wait for a program that was asked to end."""
FIGURES = ("median", "p99", "best", "worst")
"""Figures of a sample, in its unit."""
_Name = TypeVar("_Name")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Sample:
    """The raw measurements of one contestant in one case, such as "time-slice" at "200 B"; smaller
    is better.
    """

    case: str
    who: str
    values: tuple[float, ...]
    unit: str

    def __post_init__(self) -> None:
        if not self.values:
            raise ValueError(f"{self.who}, {self.case}: no measurements")

    @cached_property
    def median(self) -> float:
        """The median."""
        return float(np.median(self.values))

    @cached_property
    def p99(self) -> float:
        """The value that one in a hundred exceeds."""
        return float(np.percentile(self.values, 99.0))

    @property
    def best(self) -> float:
        """The smallest."""
        return min(self.values)

    @property
    def worst(self) -> float:
        """The largest."""
        return max(self.values)

    @property
    def count(self) -> int:
        """Number of measurements."""
        return len(self.values)


@dataclass(frozen=True)
class Absent:
    """A contestant that this machine lacks, and the command that installs it; empty: none does."""

    who: str
    reason: str
    install: str = ""

    @property
    def line(self) -> str:
        """All of it as one line."""
        hint = f"; to install: {self.install}" if self.install else ""
        return f"absent: {self.who}: {self.reason}{hint}"


def absent_package(who: str, module: str) -> tuple[Absent, ...]:
    """Return what a Python package lacks; nothing if it can be imported."""
    try:
        import_module(module)
    except ImportError as error:
        return (Absent(who, str(error), EXTRA),)
    return ()


def finished(
    called: str,
    argv: Sequence[str],
    bound_s: float,
    environment: Mapping[str, str] | None = None,
    text: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run a program, `called` so in messages, to its end, with `text` as its input. Raises
    `Failure` if it takes longer than `bound_s`. Ends it, in order if it can, if this process is
    interrupted.
    """
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        argv,
        env=environment,
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        text=True,
        errors="replace",
    )
    try:
        out, err = process.communicate(text, timeout=bound_s)
    except subprocess.TimeoutExpired:
        raise Failure(f"{called}: still running after {bound_s:g} s") from None
    finally:
        if process.poll() is None:
            _end(process)
    return subprocess.CompletedProcess(argv, process.returncode, out, err)


@contextmanager
def pinned(core: int, priority: int = 0) -> Iterator[None]:
    """Keep the calling process on a core, at a real-time priority if that is permitted, while the
    context lasts.
    """
    cores = os.sched_getaffinity(0)
    try:
        pin(core)
        set_priority(priority)
        yield
    finally:
        set_priority(0)
        os.sched_setaffinity(0, cores)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


@dataclass(frozen=True)
class Comparison:
    """All samples of a bench. `baselines` names the contestant of each case that the others are
    compared with.

    `name` is one word, as in the command; `title` says what is measured. A case without a baseline
    has no ratios. `conclusion` is what follows from the figures, in one line; empty: nothing.
    """

    name: str
    title: str
    samples: tuple[Sample, ...]
    baselines: Mapping[str, str]
    absent: tuple[Absent, ...] = ()
    conclusion: str = ""

    def sample(self, case: str, who: str) -> Sample | None:
        """Return one sample; None where the contestant was not measured."""
        return self._samples.get((case, who))

    def ratio(self, sample: Sample, figure: str = "median") -> float | None:
        """Return a figure of a sample divided by that of its baseline; None without one, or where
        that is 0.
        """
        baseline = self._samples.get((sample.case, self.baselines.get(sample.case, "")))
        if baseline is None or not getattr(baseline, figure):
            return None
        return float(getattr(sample, figure) / getattr(baseline, figure))

    @cached_property
    def _samples(self) -> dict[tuple[str, str], Sample]:
        return {(sample.case, sample.who): sample for sample in self.samples}

    def document(self) -> dict[str, Any]:
        """Return everything as plain data, without the raw values."""
        return {
            "bench": self.name,
            "title": self.title,
            "baselines": dict(self.baselines),
            "samples": [self._figures(sample) for sample in self.samples],
            "absent": [asdict(one) for one in self.absent],
            "conclusion": self.conclusion,
        }

    def _figures(self, sample: Sample) -> dict[str, Any]:
        names = ("case", "who", "unit", "count", *FIGURES)
        ratios = {"ratio": self.ratio(sample), "p99_ratio": self.ratio(sample, "p99")}
        return {name: getattr(sample, name) for name in names} | ratios

    def blocks(self) -> Blocks:
        """Yield the figures as text for people: a table, the absent contestants, the conclusion."""
        yield self.title
        rows: list[dict[str, Cell]] = [
            {
                "case": sample.case,
                "who": sample.who,
                "count": sample.count,
                **{name: shown(getattr(sample, name)) for name in FIGURES},
                "unit": sample.unit,
                "ratio": decimal(self.ratio(sample), 2),
                "p99 ratio": decimal(self.ratio(sample, "p99"), 2),
            }
            for sample in self.samples
        ]
        yield TextTable(rows, ("count", "worst", "p99 ratio", "best"))
        yield from (one.line for one in self.absent)
        if self.conclusion:
            yield self.conclusion


Found = TypeVar("Found", bound=Comparison)


def show(measure: Callable[[Progress], Found], as_json: bool) -> Found:
    """Measure, with the progress on the terminal; print what was found, and return it."""
    from rack.tools.console.progress import progress_for

    with progress_for(as_json) as progress:
        found = measure(progress)
    if as_json:
        print_json(found.document())
    else:
        print_blocks(found.blocks())
    return found


def shown(value: float) -> str:
    """Return a value with three significant digits, never in powers of ten."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def interleaved(
    contestants: Mapping[_Name, Callable[[], _Result]],
    rounds: int,
    progress: Progress | None = None,
    each_s: float = 0.0,
) -> dict[_Name, list[_Result]]:
    """Call every contestant once a round; return the results of each, oldest first.

    Every round has another order, the same in every run of the bench. Progress, if given, is told
    of each call, which takes about `each_s`.
    """
    found: dict[_Name, list[_Result]] = {name: [] for name in contestants}
    random = Random(rounds)
    for turn in range(1, rounds + 1):
        for name in random.sample([*contestants], len(contestants)):
            if progress is not None:
                words = name if isinstance(name, tuple) else (name,)
                progress.begin(f"{', '.join(map(str, words))}: round {turn} of {rounds}")
            found[name].append(contestants[name]())
            if progress is not None:
                progress.end(each_s)
    return found
