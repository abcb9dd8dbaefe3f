"""Figure 5 of the paper: which kind of concurrency suits which cycle, with the levels of a rack in it, as text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from math import log10
from typing import Any

from rack.boards.config import RackConfig
from rack.boards.config.timing import tick_ns

WIDTH = 84
SHORTEST_S, LONGEST_S = 3e-5, 1e3
"""Cycles between which the axis runs, at least."""
TICKS = {1e-4: "0.1 ms", 1e-3: "1 ms", 1e-2: "10 ms", 1e-1: "100 ms", 1.0: "1 s", 10.0: "10 s", 60.0: "1 min"}
"""Labels of the axis, s."""


@dataclass(frozen=True)
class Region:
    """A region of implementation: cycles up to `to_s`, s, what the figure calls it, and what it asks of a planner."""

    name: str
    to_s: float
    words: str
    asks: str


REGIONS = (
    Region("fine-grained", 1e-3, "fine-grained multiprocessing or dedicated hardware", "hardware of its own"),
    Region("asynchronous", 0.25, "asynchronous multiprocessing", "a processor of its own"),
    Region("multitasking", 60.0, "multitasking", "a task beside the executor, on one processor"),
    Region("distributed", float("inf"), "distributed processing, on a LAN", "a machine of its own"),
)
"""By cycle: "under 1 ms", "250 ms", "seconds", "minutes". A bound belongs to the faster region, but for 1 ms."""
COUPLING = {"tight": "multitasking", "loose": "asynchronous"}
"""What each coupling is called in the figure."""


@dataclass(frozen=True)
class Placed:
    """A level in the figure: its cycle, s, the region that this falls into, its coupling, and what to say of both."""

    level: str
    cycle_s: float
    region: str
    coupling: str
    remark: str


def placed(config: RackConfig) -> list[Placed]:
    """Return the levels of a rack in the regions of the figure, the fastest first."""
    tick_s = tick_ns(config) * 1e-9
    cycles = {name: config.every(name) * tick_s for name in config.board}
    return [_place(name, cycles[name], config.board[name].coupling) for name in sorted(cycles, key=lambda n: cycles[n])]


def region_of(cycle_s: float) -> Region:
    """Return the region of a cycle."""
    return next(r for r in REGIONS if cycle_s < r.to_s or (cycle_s == r.to_s and r is not REGIONS[0]))


def lines(config: RackConfig) -> Iterator[str]:
    """Yield the figure as text."""
    found = placed(config)
    margin = max(len(level.level) for level in found) + 2
    yield f"figure 5: the levels of {config.name} among the regions of implementation, by their cycle"
    yield ""
    yield " " * margin + _names()
    for level in found:
        yield f"{level.level:{margin}}{_row(level.cycle_s)}"
    yield " " * margin + _axis()
    yield ""
    yield from (f"{level.level}, {duration(level.cycle_s)}: {level.remark}" for level in found)


def document(config: RackConfig) -> dict[str, Any]:
    """Return the figure as plain data; the last region has no end."""
    regions = [{"name": r.words, "to_s": None if r.to_s == float("inf") else r.to_s} for r in REGIONS]
    return {"rack": config.name, "figure": 5, "regions": regions, "levels": [asdict(level) for level in placed(config)]}


def duration(cycle_s: float) -> str:
    """Return a cycle in the unit that suits it."""
    if cycle_s >= 60.0:
        return f"{cycle_s / 60.0:g} min"
    return f"{cycle_s:g} s" if cycle_s >= 1.0 else f"{cycle_s * 1e3:g} ms"


def _place(name: str, cycle_s: float, coupling: str) -> Placed:
    region = region_of(cycle_s)
    return Placed(name, cycle_s, region.words, coupling, f"{region.words}: {_remark(region, coupling)}")


def _remark(region: Region, coupling: str) -> str:
    if coupling == "none":
        return "it has no planner to couple"
    here = f"coupled {coupling}ly"
    if COUPLING[coupling] == region.name:
        return f"{here}, as the figure has it"
    asked = f"the figure gives the planner {region.asks}"
    if region.name == "asynchronous":
        return f"{asked}; here it is {here}, which does as long as eqs 3.8 and 3.10 hold"
    if region.name == "multitasking":
        return f"{asked}; here it is {here}: a processor more"
    return f"{asked}; here it is {here}"


def _column(cycle_s: float) -> int:
    part = log10(min(max(cycle_s, SHORTEST_S), LONGEST_S) / SHORTEST_S) / log10(LONGEST_S / SHORTEST_S)
    return round(part * (WIDTH - 1))


def _bounds() -> list[int]:
    return [_column(region.to_s) for region in REGIONS[:-1]]


def _names() -> str:
    row = ""
    for region, start in zip(REGIONS, [-2, *_bounds()], strict=True):
        row = row.ljust(start + 2) + region.name
    return row


def _row(cycle_s: float) -> str:
    row = ["|" if at in _bounds() else " " for at in range(WIDTH)]
    row[_column(cycle_s)] = "o"
    return "".join(row).rstrip()


def _axis() -> str:
    row = ""
    for at, label in TICKS.items():
        row = row.ljust(_column(at)) + label
    return row
