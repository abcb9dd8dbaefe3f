"""What `rack bench lan` finds, as a table and a picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rack.tools.console.pictures import paths_of, picture
from rack.tools.lab.benches.comparison import Absent, Comparison, Sample
from rack.tools.lab.benches.lan_ends import LEASE_MS, ORDER_BYTES, STATUS_BYTES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BASELINES = {"round trip": "UDP", "age": "UDP", "on the wire": "UDP", "processor": "UDP"}
"""Whom the others are compared with; in all else, with cyclonedds."""
COLOURS = {
    "rack, TLS": "#4477aa",
    "rack, TCP": "#66ccee",
    "UDP": "#222222",
    "cyclonedds": "#ccbb44",
}
TITLE = (
    f"a coordinator sends an order of {ORDER_BYTES} B to every rack, and each of these a status of"
    f" {STATUS_BYTES} B; lease {LEASE_MS} ms"
)
SIMULATED = (
    (
        "Machines are namespaces that share the cores of this one. Each rack is a process with the"
        " link, envelopes and seals of a rack's adapter; its boards are left out."
    ),
    (
        "round trip: order and status, answered at once. age: when a cycle takes a message; all"
        " have grids of their own. on the wire: at the coordinator's cable, both ways; without a"
        " rate: of links that nobody uses. processor: time of the coordinator's process, all its"
        " threads, for an order and a status."
    ),
)


class Point(NamedTuple):
    """One measurement: of what, at how many racks, at which rate (0: none), of whom, in which
    unit."""

    what: str
    racks: int
    rate_hz: float
    who: str
    unit: str

    @property
    def case(self) -> str:
        """All of it but the contestant, in words."""
        rate = f", {self.rate_hz:g} Hz" if self.rate_hz else ""
        return f"{self.what}, {self.racks} rack{'s' if self.racks > 1 else ''}{rate}"


@dataclass
class Steadiness:
    """What went wrong for one contestant while nobody disturbed it, in `rack_s`: the time of all
    its racks, s."""

    rack_s: float = 0.0
    taken: int = 0
    missing: int = 0
    false_deaths: int = 0


@dataclass(frozen=True)
class LanFigures:
    """All that was measured. `loss` is the share of packets that got lost at every rack."""

    values: Mapping[Point, tuple[float, ...]]
    steady: Mapping[str, Steadiness]
    loss: float
    is_fifo: bool
    absent: tuple[Absent, ...]

    @cached_property
    def comparison(self) -> Comparison:
        """The same as cases and contestants."""
        samples = [
            Sample(point.case, point.who, values, point.unit)
            for point, values in self.values.items()
        ]
        baselines = {point.case: BASELINES.get(point.what, "cyclonedds") for point in self.values}
        lost = f"; {100 * self.loss:g} % of packets lost at every rack" if self.loss else ""
        refused = (
            "" if self.is_fifo else "; SCHED_FIFO is refused, so all run under ordinary scheduling"
        )
        order = {case: number for number, case in enumerate(baselines)}
        samples.sort(key=lambda sample: order[sample.case])
        return Comparison("lan", TITLE + lost + refused, tuple(samples), baselines, self.absent)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data, without the raw values."""
        steady = {who: asdict(one) for who, one in self.steady.items()}
        return self.comparison.document() | {"loss": self.loss, "undisturbed": steady}

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield the figures as a table for people, fitted to `width`, and what went wrong
        undisturbed."""
        yield from SIMULATED
        yield from self.comparison.lines(width)
        for who, one in self.steady.items():
            yield (
                f"{who}, undisturbed: {one.rack_s:.0f} s of racks, {one.taken} messages taken,"
                f" {one.missing} missing, {one.false_deaths} false deaths"
            )

    def plot(self, folder: Path) -> list[Path]:
        """Write lan.png and lan.svg into `folder`: medians and p99 by the number of racks; return
        their paths."""
        paths = paths_of(folder / "lan")
        # A panel for each quantity at each rate.
        panels = list(
            dict.fromkeys((point.what, point.rate_hz, point.unit) for point in self.values)
        )
        columns = min(4, len(panels))
        rows = -(-len(panels) // columns)
        with picture(paths, 0.6 + 2.8 * columns, 1.0 + 2.1 * rows, layout="constrained") as figure:
            axes = figure.subplots(rows, columns, squeeze=False).flatten()
            for panel, (what, rate_hz, unit) in zip(axes, panels, strict=False):
                self._draw(panel, what, rate_hz)
                panel.set_title(
                    f"{what}{f', {rate_hz:g} Hz' if rate_hz else ''}", fontsize="small", loc="left"
                )
                panel.set_ylabel(unit)
            for panel in axes[len(panels) :]:
                panel.set_visible(False)
            figure.suptitle(
                f"{self.comparison.title}\nline: median; dashes: p99; by the number of racks",
                fontsize=8,
            )
        return paths

    def _draw(self, axes: Axes, what: str, rate_hz: float) -> None:
        found = [
            (point.who, point.racks, Sample(point.case, point.who, values, point.unit))
            for point, values in self.values.items()
            if (point.what, point.rate_hz) == (what, rate_hz)
        ]
        for who in dict.fromkeys(who for who, _, _ in found):
            own = sorted(
                (racks, sample.median, sample.p99) for one, racks, sample in found if one == who
            )
            racks, medians, p99s = zip(*own, strict=True)
            colour = COLOURS.get(who, "#888888")
            axes.plot(racks, medians, "o-", color=colour, markersize=3, linewidth=1, label=who)
            axes.plot(racks, p99s, "--", color=colour, linewidth=0.7)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        counts = sorted({number for _, number, _ in found})
        axes.set_xticks(counts, map(str, counts))
        axes.legend(frameon=False, fontsize=6)
        axes.spines[["top", "right"]].set_visible(False)
