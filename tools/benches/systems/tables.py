"""The figures of racks as tables, a theme each, no wider than 120 columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rack.levels.timing.trace_times import Distribution
from rack.tools.benches.comparison import shown
from rack.tools.benches.systems.kills import KillDetection
from rack.tools.benches.systems.motion import Stop
from rack.tools.console.tables import decimal, figure, table

if TYPE_CHECKING:
    from rack.tools.benches.systems.figures import SystemFigures, Systems

NARROW = ("hosts", "processes", "sum, eq. 3.3", "status up", "loads")
"""Columns of the predictions that a narrow terminal leaves out, in this order."""
NO_ARM = "no PUMA"


def lines_of(found: Systems, width: int | None) -> Iterator[str]:
    """Yield every table with its title, and what is to be said of single racks."""
    yield from _promised(found.figures, width)
    yield from _answered(found, width)
    yield from _planned(found.figures, width)
    yield from _used(found.figures, width)
    yield from _killed(found.figures, width)
    yield from _moved(found.figures, width)
    yield from _notes(found)


def _promised(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield "promised by the configs: times in ms, R_s from the release of the highest level; loads by core"
    head = ["rack", "levels", "boards", "hosts", "processes", "cores", "rates, Hz", "R_max", "bound, eq. 3.2"]
    head += ["sum, eq. 3.3", "command down", "status up", "loads", "fits"]
    rows = []
    for one in figures:
        said = one.predicted
        times = (said.longest_cycle_ms, said.bound_ms, said.sum_ms, said.command_ms, said.status_ms)
        counts = map(str, (len(said.levels) or "-", said.boards, said.hosts, said.processes, len(said.loads)))
        rates = " ".join(f"{rate:.4g}" for rate in said.rates_hz) or "-"
        fits = {True: "yes", False: "NO", None: "-"}[said.fits]
        shown_times = [f"{time:g}" if said.levels else "-" for time in times]
        rows.append([one.rack, *counts, rates, *shown_times, _loads(said.loads), fits])
    yield from table(head, rows, width, NARROW)
    for one in figures:
        yield f"{one.rack}: {' > '.join(one.predicted.levels) or 'no level above another'}"


def _answered(found: Systems, width: int | None) -> Iterator[str]:
    yield ""
    yield f"measured in {found.seconds:g} s of real time: R_s, ages and the response to a hold in ms, median/longest;"
    yield "cycles of the fastest boards missed, next to wakes that cyclictest made a cycle late, %"
    head = ["rack", "down", "up", "command age", "status age", "hold at", "hold", "longest"]
    head += ["missed", "cyclictest", "beyond"]
    rows = []
    for one in found.figures:
        ran = one.realtime
        hold = ["-"] * 3
        if ran.hold is not None:
            took = ran.hold.fate if ran.hold.measured_ms is None else decimal(ran.hold.measured_ms, 1)
            hold = [ran.hold.level, took, decimal(ran.hold.longest_ms, 1)]
        times = (ran.command_ms, ran.status_ms, ran.command_age_ms, ran.status_age_ms)
        late = None if ran.late is None else 100 * ran.late
        shares = [decimal(100 * ran.missed, 2), decimal(late, 2), decimal(100 * ran.beyond, 2)]
        rows.append([one.rack, *map(_span, times), *hold, *shares])
    yield from table(head, rows, width)


def _planned(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield "plans, ms: from a planner's release until its plan is visible, or from a host's order until levels see it"
    head = ["rack", "planner or host", "plans", "latency p50", "longest", "computing p50", "longest"]
    rows = [
        [
            *(one.rack, plan.maker, str(plan.made)),
            *(figure(times, key, 1) for times in (plan.latency_ms, plan.computed_ms) for key in ("p50", "max")),
        ]
        for one in figures
        for plan in one.realtime.plans
    ]
    yield from table(head, rows, width)
    if without := [one.rack for one in figures if not one.realtime.plans]:
        yield f"no plan made in the run: {', '.join(without)}"


def _used(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield "the bus and the processors: accesses and bytes a second of all boards, and of the busiest; shares of a core"
    head = ["rack", "accesses/s", "kB/s", "busiest", "accesses/s", "kB/s", "cores used", "by core", "most", "share"]
    rows = []
    for one in figures:
        bus, loads = one.realtime.bus, one.realtime.board_loads
        name, most = max(bus.items(), key=lambda each: each[1].accesses)
        heavy, share = max(loads.items(), key=lambda each: each[1], default=("-", 0.0))
        accesses, size = (sum(getattr(each, field) for each in bus.values()) for field in ("accesses", "bytes"))
        rows.append(
            [
                *(one.rack, f"{accesses:.0f}", f"{size / 1e3:.0f}", name),
                *(f"{most.accesses:.0f}", f"{most.bytes / 1e3:.0f}"),
                *(decimal(sum(loads.values()), 2), _loads(one.realtime.loads), heavy, decimal(share, 2)),
            ]
        )
    yield from table(head, rows, width)


def _killed(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield "each process killed once, in lockstep: ticks until the Rack knew, and until a board that reads its messages"
    yield "found them stale; unnoticed are those that were back before"
    head = ["rack", "lockstep", "killed", "Rack", "neighbour", "ms", "first", "found by", "last", "found by"]
    head += ["unnoticed"]
    rows = []
    for one in figures:
        kills = one.kills
        seen = sorted((kill for kill in kills.detections if kill.neighbour is not None), key=_ticks)
        ticks = [kill.neighbour for kill in seen if kill.neighbour is not None]
        ms = [f"{each * kills.tick_ms:g}" for each in ticks]
        ends = [(seen[at].board, seen[at].by) for at in (0, -1)] if seen else [("-", "-")] * 2
        rows.append(
            [
                *(one.rack, f"{shown(kills.speed)}x", str(len(kills.detections))),
                _between([kill.rack for kill in kills.detections]),
                _between(ticks),
                _ends(ms),
                *(name for pair in ends for name in pair),
                str(len(kills.detections) - len(seen)),
            ]
        )
    yield from table(head, rows, width)


def _moved(figures: Sequence[SystemFigures], width: int | None) -> Iterator[str]:
    yield ""
    yield "the same motion, PUMA 560, three poses from home: errors of the joints, mrad, and of the tool, mm; time from"
    yield "an operator's stop at full speed on the way to the first pose until the arm rests, ms"
    head = ["rack", "begins, s", "lasts, s", "rms", "peak", "tool", "reached", "speed, rad/s", "hold at", "rests"]
    head += ["emergency stop"]
    rows = []
    for one in figures:
        run = one.poses
        if run is None:
            rows.append([one.rack, NO_ARM, *["-"] * 9])
            continue
        # A host board takes as long as it takes, and lockstep does not wait for it.
        times = ("-" if one.predicted.hosts else decimal(run.begins_s, 2), decimal(run.lasts_s, 2))
        errors = (decimal(run.rms_mrad), decimal(run.peak_mrad), decimal(run.tool_mm))
        speed = next((decimal(stop.speed, 2) for stop in (run.hold, run.emergency) if stop is not None), "-")
        level = "-" if run.hold is None else run.hold.by
        rests = (_rests(run.hold), _rests(run.emergency))
        rows.append([one.rack, *times, *errors, str(run.reached), speed, level, *rests])
    yield from table(head, rows, width)


def _notes(found: Systems) -> Iterator[str]:
    if found.absent is not None:
        yield f"{found.absent.line}; every miss counts against the rack"
    for one in found.figures:
        commanded, hold = one.realtime.commanded, one.realtime.hold
        if commanded not in ("", *one.predicted.levels[:1]):
            queued = "the wait in the queue above it does not count as response"
            yield f"{one.rack}: down is measured from {commanded}: {queued}"
        if one.failure:
            yield f"{one.rack}: {one.failure}"
        elif hold is not None and hold.beyond:
            yield f"{one.rack}: the response to the hold took longer than the longest on the grid"


def _ticks(kill: KillDetection) -> int:
    return -1 if kill.neighbour is None else kill.neighbour


def _rests(stop: Stop | None) -> str:
    return "-" if stop is None or stop.rest_ms is None else decimal(stop.rest_ms, 0)


def _span(times: Distribution | None) -> str:
    return "-" if times is None else f"{times['p50']:.4g}/{times['max']:.4g}"


def _between(ticks: Sequence[int | None]) -> str:
    """Return the least and the greatest of ticks; "-" where one is unknown."""
    known = [str(each) for each in sorted(each for each in ticks if each is not None)]
    return _ends(known) if len(known) == len(ticks) else f"{_ends(known)}, {len(ticks) - len(known)} never"


def _ends(texts: Sequence[str]) -> str:
    return "-" if not texts else texts[0] if texts[0] == texts[-1] else f"{texts[0]} .. {texts[-1]}"


def _loads(loads: Mapping[int, float]) -> str:
    return " ".join(f"{load:.2f}" for load in loads.values()) or "-"
