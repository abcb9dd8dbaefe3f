"""Section 4.1 of the paper: the systems with which it compares its model."""

from __future__ import annotations

from functools import cache

from rack.boards.config import load, wire
from rack.levels.timing.trace_times import Distribution
from rack.tools.lab.benches.systems.bench import systems
from rack.tools.lab.benches.systems.figures import SystemFigures, SystemPrediction, prediction
from rack.tools.lab.reproduction.experiments.experiment import PICTURES, Workshop
from rack.tools.lab.reproduction.experiments.measured import (
    SYSTEMS,
    compared,
    system_experiment,
)
from rack.tools.lab.reproduction.sections.gantt import DISTURBED
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Chapter,
    Columns,
    Findings,
    Listing,
    Plate,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    text,
)

RCCL = "rccl"
RCCL_RUN = system_experiment(RCCL)


@cache
def _promise(name: str) -> SystemPrediction:
    return prediction(load(name))


def _promised(workshop: Workshop) -> Side:
    rows = [_promise_row(name, _promise(name)) for name in systems()]
    head = (
        "rack",
        "levels",
        "rates, Hz",
        "boards",
        "hosts",
        "R<sub>max</sub>",
        "n R<sub>max</sub>",
        "sum",
        "command",
        "status",
        "fits",
    )
    caption = (
        "Responses by equations 3.2 and 3.3, and on the clock's grid, ms. Hosts are boards without"
        " real time."
    )
    return [Columns(head, rows, caption)]


def _promise_row(name: str, said: SystemPrediction) -> Row:
    times_ms = (said.longest_cycle_ms, said.bound_ms, said.sum_ms, said.command_ms, said.status_ms)
    times = [f"{time_ms:g}" for time_ms in times_ms]
    if not said.levels:
        times = ["-"] * len(times)
    return (
        code(name),
        text(" → ".join(said.levels)) or "-",
        ", ".join(f"{rate:.4g}" for rate in said.rates_hz) or "-",
        said.boards,
        said.hosts,
        *times,
        said.fits,
    )


def _compared(findings: Findings) -> Assessment:
    """Judge whether all systems run, with their responses within the bounds."""
    found = compared([findings.of(one) for one in SYSTEMS])
    head = (
        "rack",
        "command down",
        "status up",
        "hold by an operator, longest",
        "killed: ticks until a neighbour",
        "missed, %",
    )
    rows = [_measured_row(figures) for figures in found.systems]
    caption = (
        "Responses in ms: longest of a run in real time. A hold is given to the highest level that"
        " takes one."
    )
    drawn = findings.workshop.shown(found.plot(findings.workshop.folder / PICTURES))
    side: Side = [
        Columns(head, rows, caption),
        Plate(
            drawn,
            "Responses with their bounds, ages of messages, and more, system by system.",
        ),
        Listing(
            "\n".join(found.lines(None)),
            f"All figures, as {code('rack bench systems')} prints them.",
        ),
    ]
    failed = [one for one in found.systems if not one.worked]
    if failed and all(one.realtime.missed > DISTURBED for one in failed):
        missed = ", ".join(
            f"{one.rack} ({100 * one.realtime.missed:.1f} % of its fastest cycles)"
            for one in failed
        )
        why = (
            f"Missed too many cycles to do its task: {missed}. Should other programs have had the"
            " processors: "
        )
        return Assessment(
            side, Ruling.UNTESTABLE, f"{why}{code('rack reproduce --only 4.1 --again')}."
        )
    if failed:
        names = "; ".join(f"{one.rack}: {one.failure}" for one in failed)
        return Assessment(side, Ruling.FAILS, f"These did not run as they should: {text(names)}.")
    late = [one.rack for one in found.systems if _is_beyond(one)]
    count = len(found.systems)
    if late:
        why = (
            f"All {count} systems run on one set of mechanisms. Beyond its bound after missed"
            f" cycles: {', '.join(late)}."
        )
        return Assessment(side, Ruling.BOUNDED, why)
    return Assessment(
        side,
        Ruling.HOLDS,
        f"All {count} systems run on one set of mechanisms, within their bounds.",
    )


def _measured_row(figures: SystemFigures) -> Row:
    ran = figures.realtime
    hold = ran.hold
    held = None
    if hold and hold.measured_ms is not None:
        held = f"{hold.measured_ms:g} of {hold.longest_ms:g} ({hold.level})"
    neighbours = [kill.neighbour for kill in figures.kills.detections]
    ticks = sorted(tick for tick in neighbours if tick is not None)
    killed = f"{ticks[0]} to {ticks[-1]}" if ticks else None
    return (
        code(figures.rack),
        _longest(ran.command_ms),
        _longest(ran.status_ms),
        held,
        killed,
        f"{100 * ran.missed:.2f}",
    )


def _longest(times: Distribution | None) -> str | None:
    return None if times is None else f"{times['max']:g}"


def _is_beyond(one: SystemFigures) -> bool:
    """Return whether a response of the run was longer than predicted."""
    ran = one.realtime
    said = one.predicted
    pairs = ((ran.command_ms, said.command_ms), (ran.status_ms, said.status_ms))
    if any(times is not None and times["max"] > bound + 1e-6 for times, bound in pairs):
        return True
    return ran.hold is not None and ran.hold.beyond


def _layered(workshop: Workshop) -> Side:
    rows = []
    for name in systems():
        said = _promise(name)
        ratio = max(said.rates_hz) / min(said.rates_hz) if said.rates_hz else 1.0
        rows.append((code(name), len(said.levels), said.hosts, f"{ratio:.4g}"))
    return [
        Columns(("rack", "levels", "boards without real time", "fastest rate to slowest"), rows)
    ]


def _layered_tested(findings: Findings) -> Assessment:
    """Judge from the configs alone: levels, and whether the slow ones are above the fast ones."""
    promised = {name: _promise(name) for name in systems()}
    flat = [name for name, said in promised.items() if len(said.levels) < 2]
    even = [name for name, said in promised.items() if sorted(said.rates_hz) != list(said.rates_hz)]
    if flat or even:
        why = (
            f"From the configs alone. Without a second level: {', '.join(flat) or 'none'}; with a"
            f" faster level above a slower one: {', '.join(even) or 'none'}."
        )
        return Assessment([], Ruling.BOUNDED, why)
    why = (
        f"From the configs alone: all {len(promised)} have at least two levels, and no level is"
        " faster than the one below."
    )
    return Assessment([], Ruling.HOLDS, why)


def _rccl(workshop: Workshop) -> Side:
    layout = wire(load(RCCL))
    rows = [
        (
            task.name,
            f"{1e9 / (task.every * layout.clock_ns):g}",
            task.core,
            task.priority or None,
        )
        for task in layout.tasks
    ]
    queues = [
        f"{code(box.name)}, {box.capacity} messages, read by {', '.join(box.readers)}"
        for box in layout.mailboxes
        if box.capacity
    ]
    return [
        Columns(("task", "rate, Hz", "processor", "priority"), rows),
        f"Queues: {'; '.join(queues)}.",
    ]


def _rccl_tested(findings: Findings) -> Assessment:
    found = findings.of(RCCL_RUN).systems[0]
    rows = [(code(name), f"{share:.3f}") for name, share in found.realtime.board_loads.items()]
    tasks = wire(load(RCCL)).tasks
    periods = [task.every for task in tasks]
    cores = {task.core for task in tasks}
    side: Side = [Columns(("board", "processor time, share of one"), rows)]
    if not found.worked:
        return Assessment(side, Ruling.FAILS, text(found.failure))
    fastest = periods.count(min(periods))
    why = (
        f"Joint control has a board a joint, but {fastest} boards of that rate share {len(cores)}"
        " processors: each joint its own processor cannot be had here. At 1 kHz"
        f" {100 * found.realtime.missed:.2f} % of their cycles were missed."
    )
    return Assessment(side, Ruling.BOUNDED, why)


CHAPTER = Chapter(
    "4.1",
    (
        Statement("systems", SYSTEMS, _promised, _compared),
        Statement("two-levels", (), _layered, _layered_tested),
        Statement("rccl", (RCCL_RUN,), _rccl, _rccl_tested),
    ),
)
