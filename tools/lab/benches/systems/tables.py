"""The figures of racks as tables, a theme each, no wider than 120 columns."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from rack.levels.timing.trace_times import Distribution
from rack.tools.console.tables import decimal, figure, table
from rack.tools.lab.benches.cyclictest import BEYOND, misses_count
from rack.tools.lab.benches.harness import Absent, BenchResult, shown
from rack.tools.lab.benches.systems.figures import SystemFigures
from rack.tools.lab.benches.systems.kills import KillDetection, KilledBoards
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
        """Yield the tables for people, a theme each, fitted to `width`."""
        yield from lines_of(self, width)

    def plot(self, folder: Path) -> list[Path]:
        """Write systems.png and systems.svg, a row a rack, into `folder`; return their paths."""
        from rack.tools.lab.benches.systems.picture import plot

        return plot(self.systems, folder)


def lines_of(found: Systems, width: int | None) -> Iterator[str]:
    """Yield every table with its title, and what is to be said of single racks."""
    yield from _made_of(found.systems, width)
    yield from _answered(found, width)
    yield from _stopped(found, width)
    yield from _planned(found.systems, width)
    yield from _used(found, width)
    yield from _late(found, width)
    yield from _killed(found.systems, width)
    yield from _moved(found.systems, width)
    yield from _notes(found)


def _made_of(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield (
        "by the configs: levels of the longest chain and their rates, cores and their predicted"
        " loads"
    )
    head = ["rack", "levels", "boards", "hosts", "processes", "cores", "rates, Hz", "loads", "fits"]
    rows = []
    for one in figures:
        said = one.predicted
        counts = map(
            str, (len(said.levels) or "-", said.boards, said.hosts, said.processes, len(said.loads))
        )
        rates = " ".join(f"{rate:.4g}" for rate in said.rates_hz) or "-"
        fits = {True: "yes", False: "NO", None: "-"}[said.fits]
        rows.append([one.rack, *counts, rates, _loads(said.loads), fits])
    yield from table(head, rows, width, NARROW)
    for one in figures:
        yield f"{one.rack}: {' > '.join(one.predicted.levels) or 'no level above another'}"


def _answered(found: Systems, width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "response R_s from the release of the highest level, and ages of messages, ms: predicted"
        " from the cycles"
    )
    yield f"alone, and measured in {found.seconds:g} s of real time, median/longest"
    head = ["rack", "R_max", "bound, eq. 3.2", "sum, eq. 3.3", "down", "measured", "up", "measured"]
    head += ["command age", "status age"]
    rows = []
    for one in found.systems:
        said = one.predicted
        ran = one.realtime
        promised = (
            said.longest_cycle_ms,
            said.bound_ms,
            said.sum_ms,
            ran.command_bound_ms,
            said.status_ms,
        )
        *cycles, down, up = (
            "-" if time is None or not said.levels else f"{time:g}" for time in promised
        )
        measured = (down, _span(ran.command_ms), up, _span(ran.status_ms))
        rows.append(
            [one.rack, *cycles, *measured, _span(ran.command_age_ms), _span(ran.status_age_ms)]
        )
    yield from table(head, rows, width, NARROW)


def _stopped(found: Systems, width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "operator's stop, ms: in real time from a hold to the torque that rests on it, next to the"
        " longest on the"
    )
    yield (
        "grid; in the same motion, at full speed, from a hold and from an emergency stop until the"
        " arm rests"
    )
    head = [
        "rack",
        "hold at",
        "torque",
        "longest",
        "in motion at",
        "speed, rad/s",
        "rest",
        "emergency stop, rest",
    ]
    rows = []
    for one in found.systems:
        hold = one.realtime.hold
        run = one.poses
        row = [one.rack, *["-"] * 3]
        if hold is not None:
            took = hold.fate if hold.measured_ms is None else decimal(hold.measured_ms, 1)
            row = [one.rack, hold.level, took, decimal(hold.longest_ms, 1)]
        if run is None:
            rows.append([*row, NO_ARM, *["-"] * 3])
        else:
            level = "-" if run.hold is None else run.hold.by
            rows.append(
                [
                    *row,
                    level,
                    decimal(run.emergency.speed, 2),
                    _rests(run.hold),
                    _rests(run.emergency),
                ]
            )
    yield from table(head, rows, width)


def _planned(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "plans, ms: from a planner's release until its plan is visible, or from a host's order"
        " until levels see it"
    )
    head = [
        "rack",
        "planner or host",
        "plans",
        "latency p50",
        "longest",
        "computing p50",
        "longest",
    ]
    rows = [
        [
            *(one.rack, plan.maker, str(plan.made)),
            *(
                figure(times, key, 1)
                for times in (plan.latency_ms, plan.computed_ms)
                for key in ("p50", "max")
            ),
        ]
        for one in figures
        for plan in one.realtime.plans
    ]
    yield from table(head, rows, width)
    if without := [one.rack for one in figures if not one.realtime.plans]:
        yield f"no plan made in the run: {', '.join(without)}"


def _used(found: Systems, width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "the bus, accesses and bytes a second, and processor time in parts of a core, without host"
        " boards"
    )
    head = [
        "rack",
        "accesses/s",
        "kB/s",
        "busiest",
        "accesses/s",
        "kB/s",
        "cores used",
        "by core",
        "most",
        "share",
    ]
    rows = []
    for one in found.systems:
        ran = one.realtime
        name, most = max(ran.bus.items(), key=lambda each: each[1].accesses)
        heavy, share = max(ran.board_loads.items(), key=lambda each: each[1], default=("-", 0.0))
        accesses, size = (
            sum(getattr(each, field) for each in ran.bus.values())
            for field in ("accesses", "bytes")
        )
        bus = (
            f"{accesses:.0f}",
            f"{size / 1e3:.0f}",
            name,
            f"{most.accesses:.0f}",
            f"{most.bytes / 1e3:.0f}",
        )
        used = (decimal(sum(ran.loads.values()), 2), _loads(ran.loads), heavy, decimal(share, 2))
        rows.append([one.rack, *bus, *used])
    yield from table(head, rows, width)


def _late(found: Systems, width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "cycles of the fastest boards missed, next to wakes that cyclictest made a cycle late on"
        " the same cores, %"
    )
    head = ["rack", "fastest, Hz", "missed", "cyclictest", "beyond"]
    rows = []
    for one in found.systems:
        ran = one.realtime
        rates = one.predicted.rates_hz
        rows.append([one.rack, f"{max(rates):.4g}" if rates else "-", *ran.cells(2)])
    yield from table(head, rows, width)


def _killed(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "each process killed once, in lockstep: ticks until the Rack knew, and until a board that"
        " reads its messages"
    )
    yield "found them stale; unnoticed are those that were back before"
    head = [
        "rack",
        "lockstep",
        "killed",
        "Rack",
        "neighbour",
        "ms",
        "first",
        "found by",
        "last",
        "found by",
    ]
    head += ["unnoticed"]
    rows = [_kill_row(one.rack, one.kills) for one in figures]
    yield from table(head, rows, width)
    for one in figures:
        by_ticks: dict[str, list[str]] = {}
        for kill in sorted(one.kills.detections, key=_ticks):
            ticks = "unnoticed" if kill.neighbour is None else f"{kill.neighbour} ticks"
            by_ticks.setdefault(ticks, []).append(kill.board)
        listed = "; ".join(f"{ticks}: {', '.join(boards)}" for ticks, boards in by_ticks.items())
        yield from wrap(f"{one.rack}: {listed}", PAGE, subsequent_indent="  ")


def _kill_row(rack: str, kills: KilledBoards) -> list[str]:
    seen = sorted((kill for kill in kills.detections if kill.neighbour is not None), key=_ticks)
    ms = [f"{_ticks(kill) * kills.tick_ms:g}" for kill in seen]
    ends = [(seen[at].board, seen[at].by) for at in (0, -1)] if seen else [("-", "-")] * 2
    return [
        *(rack, f"{shown(kills.speed)}x", str(len(kills.detections))),
        *(
            _between([kill.rack for kill in kills.detections]),
            _between([kill.neighbour for kill in seen]),
            _ends(ms),
        ),
        *(name for pair in ends for name in pair),
        str(len(kills.detections) - len(seen)),
    ]


def _moved(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield (
        "the same motion, PUMA 560, three poses from home, at rest in each: time from the first"
        " motion to rest in the"
    )
    yield "last pose, errors of the joints while they move, and the farthest of the tool"
    head = ["rack", "begins, s", "lasts, s", "rms, mrad", "peak, mrad", "tool, mm", "poses reached"]
    rows = []
    for one in figures:
        run = one.poses
        if run is None:
            rows.append([one.rack, NO_ARM, *["-"] * 5])
            continue
        # A host board takes as long as it takes, and lockstep does not wait for it.
        begins = "-" if one.predicted.hosts else decimal(run.begins_s, 2)
        errors = (decimal(run.rms_mrad), decimal(run.peak_mrad), decimal(run.tool_mm))
        rows.append([one.rack, begins, decimal(run.lasts_s, 2), *errors, str(run.reached)])
    yield from table(head, rows, width)


def _notes(found: Systems) -> Iterator[str]:
    yield from misses_count(found.absent)
    for one in found.systems:
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
    return "-" if stop is None or stop.rest_ms is None else decimal(stop.rest_ms, 0)


def _span(times: Distribution | None) -> str:
    return "-" if times is None else f"{times['p50']:.4g}/{times['max']:.4g}"


def _between(ticks: Sequence[int | None]) -> str:
    """Return the least and the greatest of ticks; "-" where one is unknown."""
    known = [str(each) for each in sorted(each for each in ticks if each is not None)]
    return (
        _ends(known)
        if len(known) == len(ticks)
        else f"{_ends(known)}, {len(ticks) - len(known)} never"
    )


def _ends(texts: Sequence[str]) -> str:
    return "-" if not texts else texts[0] if texts[0] == texts[-1] else f"{texts[0]} .. {texts[-1]}"


def _loads(loads: Mapping[int, float]) -> str:
    return " ".join(f"{load:.2f}" for load in loads.values()) or "-"
