"""The figures of racks as tables, a theme each, no wider than 120 columns."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

from rack.levels.timing.trace_times import Distribution
from rack.tools.console.tables import figure, table
from rack.tools.lab.benches.cyclictest import BEYOND, misses_count
from rack.tools.lab.benches.harness import Absent, BenchResult, shown
from rack.tools.lab.benches.systems.figures import SystemFigures
from rack.tools.lab.benches.systems.kills import KillDetection
from rack.tools.lab.benches.systems.motion import Stop

NARROW = ("processes", "hosts", "R_max", "sum, eq. 3.3", "status age", "command age")
"""Columns that a narrow terminal leaves out, in this order."""
PAGE = 118
"""Characters in a line of text."""
NO_ARM = "no PUMA"


@dataclass(frozen=True)
class Systems(BenchResult):
    """The figures of every rack; `seconds` is the length of a run, `absent` the peer that this
    machine lacks."""

    name = "systems"

    systems: tuple[SystemFigures, ...]
    seconds: float
    absent: tuple[Absent, ...]
    permitted_beyond: float = BEYOND

    @property
    def worked(self) -> bool:
        """Whether all of them worked."""
        return all(one.worked for one in self.systems)

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield every table with its title, fitted to `width`, and what is to be said of single
        racks."""
        for theme in THEMES:
            if theme is not THEMES[0]:
                yield ""
            yield from theme.title.format(seconds=self.seconds).splitlines()
            rows = [row for one in self.systems for row in theme.rows(one)]
            yield from table(theme.head, rows, width, NARROW)
            yield from theme.notes(self.systems)
        yield from misses_count(self.absent)
        for one in self.systems:
            yield from _notes(one)

    def plot(self, folder: Path) -> list[Path]:
        """Write systems.png and systems.svg, a row a rack, into `folder`; return their paths."""
        from rack.tools.lab.benches.systems.picture import plot

        return plot(self.systems, folder)


class Theme(NamedTuple):
    """A table: its title, which may name the `seconds` of a run, its head, and the rows of a rack;
    `notes` are the lines below it."""

    title: str
    head: Sequence[str]
    rows: Callable[[SystemFigures], Iterator[Sequence[str]]]
    notes: Callable[[Sequence[SystemFigures]], Iterator[str]] = lambda figures: iter(())


def _made_of(one: SystemFigures) -> Iterator[Sequence[str]]:
    said = one.predicted
    counts = (len(said.levels) or "-", said.boards, said.hosts, said.processes, len(said.loads))
    rates = " ".join(f"{rate:.4g}" for rate in said.rates_hz) or "-"
    fits = {True: "yes", False: "NO", None: "-"}[said.fits]
    yield [one.rack, *map(str, counts), rates, _loads(said.loads), fits]


def _levels(figures: Sequence[SystemFigures]) -> Iterator[str]:
    for one in figures:
        yield f"{one.rack}: {' > '.join(one.predicted.levels) or 'no level above another'}"


def _answered(one: SystemFigures) -> Iterator[Sequence[str]]:
    said = one.predicted
    ran = one.realtime
    bounds = (said.longest_cycle_ms, said.bound_ms, said.sum_ms, ran.command_bound_ms)
    *cycles, down, up = (
        "-" if time_ms is None or not said.levels else f"{time_ms:g}"
        for time_ms in (*bounds, said.status_ms)
    )
    measured = (down, _span(ran.command_ms), up, _span(ran.status_ms))
    yield [one.rack, *cycles, *measured, _span(ran.command_age_ms), _span(ran.status_age_ms)]


def _stopped(one: SystemFigures) -> Iterator[Sequence[str]]:
    held = ["-"] * 3
    if (hold := one.realtime.hold) is not None:
        took = hold.fate if hold.measured_ms is None else f"{hold.measured_ms:.1f}"
        held = [hold.level, took, f"{hold.longest_ms:.1f}"]
    moved = [NO_ARM, *["-"] * 3]
    if (run := one.poses) is not None:
        level = "-" if run.hold is None else run.hold.by
        speed = f"{run.emergency.speed:.2f}"
        moved = [level, speed, _rests(run.hold), _rests(run.emergency)]
    yield [one.rack, *held, *moved]


def _planned(one: SystemFigures) -> Iterator[Sequence[str]]:
    for plan in one.realtime.plans:
        times = [
            figure(found, key, 1)
            for found in (plan.latency_ms, plan.computed_ms)
            for key in ("p50", "max")
        ]
        yield [one.rack, plan.maker, f"{plan.made}", *times]


def _unplanned(figures: Sequence[SystemFigures]) -> Iterator[str]:
    if without := [one.rack for one in figures if not one.realtime.plans]:
        yield f"no plan made in the run: {', '.join(without)}"


def _used(one: SystemFigures) -> Iterator[Sequence[str]]:
    ran = one.realtime
    name, most = max(ran.bus.items(), key=lambda each: each[1].accesses)
    heavy, share = max(ran.board_loads.items(), key=lambda each: each[1], default=("-", 0.0))
    traffic = ran.bus.values()
    accesses = sum(each.accesses for each in traffic), sum(each.bytes for each in traffic)
    bus = (*_accesses(*accesses), name, *_accesses(most.accesses, most.bytes))
    used = (f"{sum(ran.loads.values()):.2f}", _loads(ran.loads), heavy, f"{share:.2f}")
    yield [one.rack, *bus, *used]


def _accesses(count: float, size: float) -> tuple[str, str]:
    return f"{count:.0f}", f"{size / 1e3:.0f}"


def _late(one: SystemFigures) -> Iterator[Sequence[str]]:
    rates = one.predicted.rates_hz
    fastest = f"{max(rates):.4g}" if rates else "-"
    yield [one.rack, fastest, *one.realtime.cells(2)]


def _killed(one: SystemFigures) -> Iterator[Sequence[str]]:
    kills = one.kills
    seen = sorted((kill for kill in kills.detections if kill.neighbour is not None), key=_ticks)
    ms = [f"{_ticks(kill) * kills.tick_ms:g}" for kill in seen]
    first, last = [(seen[at].board, seen[at].by) for at in (0, -1)] if seen else [("-", "-")] * 2
    count = len(kills.detections)
    ticks = [_between([kill.rack for kill in kills.detections])]
    ticks.append(_between([kill.neighbour for kill in seen]))
    speed = f"{shown(kills.speed)}x"
    yield [one.rack, speed, f"{count}", *ticks, _ends(ms), *first, *last, f"{count - len(seen)}"]


def _noticed(figures: Sequence[SystemFigures]) -> Iterator[str]:
    for one in figures:
        by_ticks: dict[str, list[str]] = {}
        for kill in sorted(one.kills.detections, key=_ticks):
            ticks = "unnoticed" if kill.neighbour is None else f"{kill.neighbour} ticks"
            by_ticks.setdefault(ticks, []).append(kill.board)
        listed = "; ".join(f"{ticks}: {', '.join(boards)}" for ticks, boards in by_ticks.items())
        yield from wrap(f"{one.rack}: {listed}", PAGE, subsequent_indent="  ")


def _moved(one: SystemFigures) -> Iterator[Sequence[str]]:
    run = one.poses
    if run is None:
        yield [one.rack, NO_ARM, *["-"] * 5]
        return
    # A host board takes as long as it takes, and lockstep does not wait for it.
    begins = "-" if one.predicted.hosts else f"{run.begins_s:.2f}"
    errors = (f"{run.rms_mrad:.3f}", f"{run.peak_mrad:.3f}", f"{run.tool_mm:.3f}")
    yield [one.rack, begins, f"{run.lasts_s:.2f}", *errors, f"{run.reached}"]


THEMES = (
    Theme(
        "by the configs: levels of the longest chain and their rates, cores and their predicted"
        " loads",
        ("rack", "levels", "boards", "hosts", "processes", "cores", "rates, Hz", "loads", "fits"),
        _made_of,
        _levels,
    ),
    Theme(
        "response R_s from the release of the highest level, and ages of messages, ms: predicted"
        " from the cycles\nalone, and measured in {seconds:g} s of real time, median/longest",
        (
            *("rack", "R_max", "bound, eq. 3.2", "sum, eq. 3.3", "down", "measured"),
            *("up", "measured", "command age", "status age"),
        ),
        _answered,
    ),
    Theme(
        "operator's stop, ms: in real time from a hold to the torque that rests on it, next to the"
        " longest on the\ngrid; in the same motion, at full speed, from a hold and from an"
        " emergency stop until the arm rests",
        (
            *("rack", "hold at", "torque", "longest"),
            *("in motion at", "speed, rad/s", "rest", "emergency stop, rest"),
        ),
        _stopped,
    ),
    Theme(
        "plans, ms: from a planner's release until its plan is visible, or from a host's order"
        " until levels see it",
        (
            *("rack", "planner or host", "plans"),
            *("latency p50", "longest", "computing p50", "longest"),
        ),
        _planned,
        _unplanned,
    ),
    Theme(
        "the bus, accesses and bytes a second, and processor time in parts of a core, without host"
        " boards",
        (
            *("rack", "accesses/s", "kB/s", "busiest", "accesses/s", "kB/s"),
            *("cores used", "by core", "most", "share"),
        ),
        _used,
    ),
    Theme(
        "cycles of the fastest boards missed, next to wakes that cyclictest made a cycle late on"
        " the same cores, %",
        ("rack", "fastest, Hz", "missed", "cyclictest", "beyond"),
        _late,
    ),
    Theme(
        "each process killed once, in lockstep: ticks until the Rack knew, and until a board that"
        " reads its messages\nfound them stale; unnoticed are those that were back before",
        (
            *("rack", "lockstep", "killed", "Rack", "neighbour", "ms"),
            *("first", "found by", "last", "found by", "unnoticed"),
        ),
        _killed,
        _noticed,
    ),
    Theme(
        "the same motion, PUMA 560, three poses from home, at rest in each: time from the first"
        " motion to rest in the\nlast pose, errors of the joints while they move, and the farthest"
        " of the tool",
        ("rack", "begins, s", "lasts, s", "rms, mrad", "peak, mrad", "tool, mm", "poses reached"),
        _moved,
    ),
)


def _notes(one: SystemFigures) -> Iterator[str]:
    commanded = one.realtime.commanded
    hold = one.realtime.hold
    if commanded not in ("", *one.predicted.levels[:1]):
        queued = "the wait in the queue above it does not count as response"
        yield f"{one.rack}: down is measured from {commanded}: {queued}"
    if one.failure:
        yield f"{one.rack}: {one.failure}"
    elif hold is not None and hold.beyond:
        yield f"{one.rack}: the response to the hold took longer than the longest on the grid"


def _ticks(kill: KillDetection) -> int:
    return sys.maxsize if kill.neighbour is None else kill.neighbour


def _rests(stop: Stop | None) -> str:
    return "-" if stop is None or stop.rest_ms is None else f"{stop.rest_ms:.0f}"


def _span(times: Distribution | None) -> str:
    return "-" if times is None else f"{times['p50']:.4g}/{times['max']:.4g}"


def _between(ticks: Sequence[int | None]) -> str:
    """Return the least and the greatest of ticks; "-" where one is unknown."""
    known = [f"{each}" for each in sorted(each for each in ticks if each is not None)]
    return (
        _ends(known)
        if len(known) == len(ticks)
        else f"{_ends(known)}, {len(ticks) - len(known)} never"
    )


def _ends(texts: Sequence[str]) -> str:
    if not texts:
        return "-"
    return texts[0] if texts[0] == texts[-1] else f"{texts[0]} .. {texts[-1]}"


def _loads(loads: Mapping[int, float]) -> str:
    return " ".join(f"{load:.2f}" for load in loads.values()) or "-"
