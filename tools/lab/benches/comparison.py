"""What a bench finds: contestants in the same cases, measured by turns, as figures, ratios and
pictures.

A machine's speed drifts by a factor of two within a day, so no time means much alone: every
contestant is measured in the same minutes as the baseline of its case, and judged by the ratio of
medians.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from rack.tools.console.pictures import paths_of, picture
from rack.tools.console.tables import decimal, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EXTRA = "pip install .[bench]"
"""Brings the peers that are Python packages."""
COLUMNS = 4
"""Panels next to each other in a picture, at most."""
ROW_IN = 0.34
"""Height of a contestant's row."""
WIDE = 15.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""
MEDIAN = "#4477aa"
BASELINE = "#222222"
SPREAD = "#bbccdd"
"""Colours that people with any kind of colour vision can distinguish (after Paul Tol's)."""
KEY = "dot: median (ratio to the black one of the case); line: best to p99"
_PAPER = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
LABEL: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 6.5, "bbox": _PAPER}
_Name = TypeVar("_Name")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Sample:
    """The raw measurements of one contestant in one case, such as "time-slice" at "200 B"; smaller
    is better."""

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
        return (
            f"absent: {self.who}:"
            f" {self.reason}{'; to install: ' if self.install else ''}{self.install}"
        )


def absent_package(who: str, module: str) -> Absent | None:
    """Return what a Python package lacks; None if it can be imported."""
    try:
        import_module(module)
    except ImportError as error:
        return Absent(who, str(error), EXTRA)
    return None


def absent_program(who: str, program: str, debian: str) -> Absent | None:
    """Return what a program of a Debian package lacks; None if it is on the path."""
    return (
        None
        if shutil.which(program)
        else Absent(who, f"no program '{program}'", f"apt-get install {debian}")
    )


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

    @property
    def cases(self) -> list[str]:
        """The cases, in order."""
        return list(dict.fromkeys(sample.case for sample in self.samples))

    @property
    def contestants(self) -> list[str]:
        """The contestants, in order."""
        return list(dict.fromkeys(sample.who for sample in self.samples))

    def sample(self, case: str, who: str) -> Sample | None:
        """Return one sample; None where the contestant was not measured."""
        return self._samples.get((case, who))

    def ratio(self, sample: Sample, figure: str = "median") -> float | None:
        """Return a figure of a sample divided by that of its baseline; None without one, or where
        that is 0."""
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
        names = ("case", "who", "unit", "count", "median", "p99", "best", "worst")
        ratios = {"ratio": self.ratio(sample), "p99_ratio": self.ratio(sample, "p99")}
        return {name: getattr(sample, name) for name in names} | ratios

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as a table for people, fitted to `width`, and the absent
        contestants."""
        yield self.title
        head = [
            "case",
            "who",
            "count",
            "median",
            "p99",
            "best",
            "worst",
            "unit",
            "ratio",
            "p99 ratio",
        ]
        rows = [self._row(sample) for sample in self.samples]
        yield from table(head, rows, width, ("count", "worst", "p99 ratio", "best"))
        for one in self.absent:
            yield one.line
        if self.conclusion:
            yield self.conclusion

    def _row(self, sample: Sample) -> list[str]:
        figures = [shown(getattr(sample, name)) for name in ("median", "p99", "best", "worst")]
        ratios = [decimal(self.ratio(sample, name), 2) for name in ("median", "p99")]
        return [sample.case, sample.who, str(sample.count), *figures, sample.unit, *ratios]

    def plot(self, folder: Path) -> list[Path]:
        """Write the comparison as PNG and SVG, a panel a case, into `folder`; return their
        paths."""
        cases = self.cases
        who = self.contestants
        columns = min(COLUMNS, len(cases))
        rows = -(-len(cases) // columns)
        paths = paths_of(folder / self.name)
        size = 1.6 + 2.6 * columns, 0.9 + rows * (0.75 + ROW_IN * len(who))
        with picture(paths, *size, layout="constrained") as figure:
            axes = figure.subplots(rows, columns, squeeze=False, sharey=True).flatten()
            for panel, case in zip(axes, cases, strict=False):
                self._draw(panel, case)
            for panel in axes[len(cases) :]:
                panel.set_visible(False)
            axes[0].set_ylim(len(who) - 0.4, -0.6)
            axes[0].set_yticks(range(len(who)), who)
            figure.suptitle(f"{self.title}\n{KEY}", fontsize="medium")
        return paths

    def _draw(self, axes: Axes, case: str) -> None:
        """Draw one case: a dot at each median, a line from best to p99, and a rule at the
        baseline's median."""
        from matplotlib.ticker import StrMethodFormatter

        own = [sample for sample in self.samples if sample.case == case]
        alike = [sample for sample in self.samples if sample.unit == own[0].unit]
        # A best of 0 has no place on a logarithmic axis.
        low = min(sample.best or sample.median for sample in alike)
        high = max(sample.p99 for sample in alike)
        for sample in own:
            row = self.contestants.index(sample.who)
            is_baseline = self.baselines.get(case) == sample.who
            axes.hlines(row, sample.best, sample.p99, color=SPREAD, linewidth=3)
            axes.plot(
                sample.median, row, "o", color=BASELINE if is_baseline else MEDIAN, markersize=5
            )
            if is_baseline:
                axes.axvline(sample.median, color=BASELINE, linewidth=0.8, linestyle=":")
            axes.annotate(
                self._words(sample),
                (sample.median, row),
                (0, 5),
                textcoords="offset points",
                **LABEL,
            )
        is_wide = low > 0 and high > WIDE * low
        axes.set_xscale("log" if is_wide else "linear")
        axes.set_xlim(*((low / 1.6, high * 1.6) if is_wide else (0.0, 1.15 * high)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.set_title(case, fontsize="small", loc="left")
        axes.set_xlabel(own[0].unit)
        axes.grid(axis="x", color=SPREAD, linewidth=0.4)
        axes.tick_params(axis="y", length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)

    def _words(self, sample: Sample) -> str:
        ratio = self.ratio(sample)
        return shown(sample.median) + ("" if ratio is None else f"  ({ratio:.2f})")


def shown(value: float) -> str:
    """Return a value with three significant digits, never in powers of ten."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def turns(names: Sequence[_Name], rounds: int) -> Iterator[tuple[int, _Name]]:
    """Yield round and contestant; every round has another order, the same in every run of the
    bench."""
    random = Random(rounds)
    for turn in range(rounds):
        for name in random.sample(list(names), len(names)):
            yield turn, name


def interleaved(
    contestants: Mapping[_Name, Callable[[], _Result]], rounds: int
) -> dict[_Name, list[_Result]]:
    """Call every contestant once a round, in changing order; return the results of each, oldest
    first."""
    found: dict[_Name, list[_Result]] = {name: [] for name in contestants}
    for _, name in turns(list(contestants), rounds):
        found[name].append(contestants[name]())
    return found
