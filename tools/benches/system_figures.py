"""The figures by which racks are compared, as tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rack.levels.timing.trace_times import Distribution
from rack.tools.benches.comparison import Absent, shown
from rack.tools.benches.cyclictest import BEYOND, MissesBeyond
from rack.tools.console.pictures import paths_of, picture
from rack.tools.console.tables import decimal, figure, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BOUND, GRID, PEER = "#bbccdd", "#88aacc", "#222222"
COMMAND, STATUS, HELD = "#4477aa", "#ee6677", "#ccbb44"
ROUNDING_MS = 1e-6
LOWER = 0.12
"""Part of a row between marks of commands and of statuses, and its middle."""
NARROW = ("hosts", "processes", "sum, eq. 3.3", "status up", "loads")
"""Columns of the predictions that a narrow terminal leaves out, in this order."""
NARROW_MEASURED = ("late", "status age p50", "command age p50", "up p50", "down p50", "loads")
"""Columns of the measurements, likewise."""


class Marks(NamedTuple):
    """The shape and colour of a series of marks, and what it shows."""

    shape: str
    colour: str
    label: str


@dataclass(frozen=True)
class SystemPrediction:
    """What a config promises, times in ms. `levels` are those of its longest response, the highest first.

    `boards` are the slots that it takes besides the clock's, `hosts` its boards without real time; `processes` are
    those that it starts. `fits` is None without a budget; `loads` are by core.
    """

    levels: tuple[str, ...]
    boards: int
    hosts: int
    processes: int
    rates_hz: tuple[float, ...]
    longest_cycle_ms: float
    bound_ms: float
    sum_ms: float
    command_ms: float
    status_ms: float
    loads: Mapping[int, float]
    fits: bool | None


@dataclass(frozen=True)
class HoldResponse:
    """The response to an operator's hold, from giving it to the end of the lowest level's cycle that rests on it, ms.

    `measured_ms` and `longest_ms`, the longest on the grid, are simulated time, `wall_ms` is the wall clock's. `fate`
    is what became of the command; unless it was acted on, nothing was measured.
    """

    level: str
    fate: str
    measured_ms: float | None
    longest_ms: float
    wall_ms: float | None

    @property
    def beyond(self) -> bool:
        """Whether it took longer than the longest on the grid."""
        return self.measured_ms is not None and self.measured_ms > self.longest_ms + ROUNDING_MS


@dataclass(frozen=True)
class SystemFigures(MissesBeyond):
    """One rack: what its config promises, and what its runs have shown; times in ms of simulated time.

    `missed` is the share of the cycles of its fastest boards. `command_ms` and `status_ms` are the response measured
    down the hierarchy from `commanded`, which is below a queue if there is one, and up. Ages are those of commands when
    the lowest level reads them, and of its statuses when they are read above. None: the rack has no such thing.
    """

    rack: str
    predicted: SystemPrediction
    lockstep_speed: float
    missed: float
    late: float | None
    loads: Mapping[int, float]
    commanded: str
    command_ms: Distribution | None
    status_ms: Distribution | None
    command_age_ms: Distribution | None
    status_age_ms: Distribution | None
    hold: HoldResponse | None
    failure: str

    @property
    def worked(self) -> bool:
        """Whether both of its runs worked."""
        return not self.failure

    @property
    def verdict(self) -> str:
        """The same in words."""
        if self.failure:
            return self.failure
        return "held" if self.held else f"{100 * self.beyond:.2f} % missed beyond cyclictest"


@dataclass(frozen=True)
class Systems:
    """The figures of every rack; `seconds` is the length of a run, `absent` the peer that this machine lacks."""

    figures: tuple[SystemFigures, ...]
    seconds: float
    absent: Absent | None

    @property
    def worked(self) -> bool:
        """Whether all of them worked."""
        return all(one.worked for one in self.figures)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        extra = ("beyond", "held", "worked")
        return {
            "bench": "systems",
            "seconds": self.seconds,
            "systems": [{**asdict(one), **{name: getattr(one, name) for name in extra}} for one in self.figures],
            "permitted_beyond": BEYOND,
            "absent": [] if self.absent is None else [asdict(self.absent)],
        }

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield both tables for people, fitted to `width`: what the configs promise, and what the runs have shown."""
        yield "what the configs promise: times in ms, R_s from the release of the highest level; loads by core"
        head = [
            "rack",
            "levels",
            "boards",
            "hosts",
            "processes",
            "rates, Hz",
            "R_max",
            "bound, eq. 3.2",
            "sum, eq. 3.3",
        ]
        head += ["command down", "status up", "loads", "fits"]
        yield from table(head, [_promised(one) for one in self.figures], width, NARROW)
        for one in self.figures:
            yield f"{one.rack}: {' > '.join(one.predicted.levels) or 'no level above another'}"
        yield ""
        yield f"what runs of {self.seconds:g} s have shown, in ms; lockstep in times real time, missed and late in %"
        head = ["rack", "lockstep", "missed", "late", "beyond", "down p50", "down max", "up p50", "up max"]
        head += ["command age p50", "max", "status age p50", "max", "loads", "hold at", "hold", "longest"]
        yield from table(head, [_shown(one) for one in self.figures], width, NARROW_MEASURED)
        if self.absent is not None:
            yield f"{self.absent.line}; every miss counts against the rack"
        for one in self.figures:
            if one.commanded not in ("", *one.predicted.levels[:1]):
                queued = "the wait in the queue above it does not count as response"
                yield f"{one.rack}: down is measured from {one.commanded}: {queued}"
            if one.failure:
                yield f"{one.rack}: {one.failure}"
            elif one.hold is not None and one.hold.beyond:
                yield f"{one.rack}: the response to the hold took longer than the longest on the grid"

    def plot(self, folder: Path) -> list[Path]:
        """Write systems.png and systems.svg, a row a rack, into `folder`; return their paths."""
        paths = paths_of(folder / "systems")
        with picture(paths, 11.0, 1.6 + 0.55 * len(self.figures), layout="constrained") as drawn:
            axes = drawn.subplots(1, 4, sharey=True, width_ratios=(3, 2, 2, 2))
            self._draw_responses(axes[0])
            self._draw_ages(axes[1])
            _bars(axes[2], [one.lockstep_speed for one in self.figures], "lockstep, times real time")
            late = [None if one.late is None else 100 * one.late for one in self.figures]
            _bars(axes[3], [100 * one.missed for one in self.figures], "missed, % of the fastest cycles", late)
            _mark(axes[3], late, Marks("D", PEER, "cyclictest: late by a cycle"))
            axes[0].set_yticks(range(len(self.figures)), [one.rack for one in self.figures])
            axes[0].invert_yaxis()
            for each in axes:
                each.grid(axis="x", color=BOUND, linewidth=0.4)
                each.spines[["top", "right"]].set_visible(False)
            drawn.legend(loc="outside lower center", ncols=4, frameon=False, fontsize="small")
        return paths

    def _draw_responses(self, axes: Axes) -> None:
        """Draw the bounds of the response as bars, what was measured as marks."""
        rows = range(len(self.figures))
        predicted = [one.predicted for one in self.figures]
        axes.barh(rows, [one.bound_ms for one in predicted], 0.6, color=BOUND, label="bound, eq. 3.2")
        axes.barh(rows, [one.command_ms for one in predicted], 0.3, color=GRID, label="command, on the grid")
        down = [None if one.command_ms is None else one.command_ms["max"] for one in self.figures]
        up = [None if one.status_ms is None else one.status_ms["max"] for one in self.figures]
        hold = [None if one.hold is None else one.hold.measured_ms for one in self.figures]
        _mark(axes, down, Marks("o", COMMAND, "command measured, longest"), -LOWER)
        _mark(axes, up, Marks("s", STATUS, "status measured, longest"), LOWER)
        _mark(axes, hold, Marks("D", HELD, "hold by an operator"))
        _scale(axes, "response R_s, ms")

    def _draw_ages(self, axes: Axes) -> None:
        """Draw ages from the least to the greatest as lines, their medians as marks."""
        for name, marks, lower in (
            ("command", Marks("o", COMMAND, "age of a command"), -LOWER),
            ("status", Marks("s", STATUS, "age of a status"), LOWER),
        ):
            found = [getattr(one, f"{name}_age_ms") for one in self.figures]
            for row, ages in enumerate(found):
                if ages is not None:
                    axes.hlines(row + lower, ages["min"], ages["max"], color=marks.colour, linewidth=1)
            _mark(axes, [None if ages is None else ages["p50"] for ages in found], marks, lower)
        _scale(axes, "age at the lowest level, ms")


def _mark(axes: Axes, values: Sequence[float | None], marks: Marks, lower: float = 0.0) -> None:
    """Mark a value in each row, `lower` by a part of a row."""
    places = [(value, row + lower) for row, value in enumerate(values) if value is not None]
    if places:
        axes.plot(*zip(*places, strict=True), marks.shape, color=marks.colour, markersize=5, label=marks.label)


def _bars(axes: Axes, values: Sequence[float], label: str, others: Sequence[float | None] = ()) -> None:
    """Draw a bar in each row; `others` have their place on the axis, too."""
    axes.barh(range(len(values)), values, 0.6, color=GRID)
    for row, value in enumerate(values):
        axes.annotate(shown(value), (value, row), (3, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_xlim(0.0, 1.25 * max(filter(None, (*values, *others)), default=0.8))
    axes.set_xlabel(label)


def _scale(axes: Axes, label: str) -> None:
    """Make the axis of times logarithmic, with plain numbers."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label)


def _promised(one: SystemFigures) -> list[str]:
    found = one.predicted
    times = (found.longest_cycle_ms, found.bound_ms, found.sum_ms, found.command_ms, found.status_ms)
    fits = {True: "yes", False: "NO", None: "-"}[found.fits]
    rates = " ".join(f"{rate:.4g}" for rate in found.rates_hz) or "-"
    shown_times = [f"{time:g}" if found.levels else "-" for time in times]
    counts = map(str, (len(found.levels) or "-", found.boards, found.hosts, found.processes))
    return [one.rack, *counts, rates, *shown_times, _loads(found.loads), fits]


def _shown(one: SystemFigures) -> list[str]:
    late = None if one.late is None else 100 * one.late
    responses = [figure(found, key, 1) for found in (one.command_ms, one.status_ms) for key in ("p50", "max")]
    ages = [figure(found, key, 1) for found in (one.command_age_ms, one.status_age_ms) for key in ("p50", "max")]
    hold = ["-"] * 3
    if one.hold is not None:
        took = one.hold.fate if one.hold.measured_ms is None else decimal(one.hold.measured_ms, 1)
        hold = [one.hold.level, took, decimal(one.hold.longest_ms, 1)]
    shares = [decimal(100 * one.missed, 2), decimal(late, 2), decimal(100 * one.beyond, 2)]
    return [one.rack, shown(one.lockstep_speed), *shares, *responses, *ages, _loads(one.loads), *hold]


def _loads(loads: Mapping[int, float]) -> str:
    return " ".join(f"{load:.2f}" for load in loads.values()) or "-"
