"""What `rack bench lan` finds, as a table and a picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from rack.boards.faults.bounds import counting
from rack.tools.lab.benches.chart import PALETTE, Diagram, Series, draw
from rack.tools.lab.benches.harness import Absent, BenchResult, Comparison, Sample, plain
from rack.tools.lab.benches.lan_ends import LEASE_MS, ORDER_BYTES, STATUS_BYTES

BASELINES = {"round trip": "UDP", "age": "UDP", "on the wire": "UDP", "processor": "UDP"}
"""Whom the others are compared with; in all else, with cyclonedds."""
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
        return f"{self.what}, {counting(self.racks, 'rack')}{rate}"


@dataclass
class Steadiness:
    """What went wrong for one contestant while nobody disturbed it, in `rack_s`: the time of all
    its racks, s."""

    rack_s: float = 0.0
    taken: int = 0
    missing: int = 0
    false_deaths: int = 0


@dataclass(frozen=True)
class LanFigures(BenchResult):
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
        cases = list(baselines)
        samples.sort(key=lambda sample: cases.index(sample.case))
        return Comparison("lan", TITLE + lost + refused, tuple(samples), baselines, self.absent)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data, without the raw values."""
        steady = plain(self.steady)
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
        """Write medians and p99 by the number of racks, a panel a quantity and rate; return the
        paths."""
        kinds = dict.fromkeys((point.what, point.rate_hz, point.unit) for point in self.values)
        title = f"{self.comparison.title}\nline: median; dashes: p99"
        return draw(folder / "lan", title, [self._diagram(*kind) for kind in kinds])

    def _diagram(self, what: str, rate_hz: float, unit: str) -> Diagram:
        everyone = list(dict.fromkeys(point.who for point in self.values))
        series = []
        for who, colour in zip(everyone, PALETTE, strict=False):
            own = sorted(
                point
                for point in self.values
                if (point.what, point.rate_hz, point.who) == (what, rate_hz, who)
            )
            racks = [point.racks for point in own]
            samples = [Sample(point.case, who, self.values[point], unit) for point in own]
            medians = [sample.median for sample in samples]
            series.append(Series(who, racks, medians, "o-", colour))
            series.append(Series("", racks, [sample.p99 for sample in samples], "--", colour))
        rate = f", {rate_hz:g} Hz" if rate_hz else ""
        return Diagram("racks", series, unit, f"{what}{rate}")
