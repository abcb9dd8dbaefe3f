"""Abstract and introduction of the paper: determinism first, and the cost of communication."""

from __future__ import annotations

from rack.boards.config import load, rack_timing, wire
from rack.tools.lab.reproduction.experiments.determinism import (
    ATTEMPTS,
    DETERMINISM,
    NAME,
    SECONDS,
    ComparedRun,
)
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.nasrem import NASREM
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Chapter,
    Columns,
    Findings,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    text,
)

REAL = "realtime"
LOCKSTEP = "lockstep"


def _determined(workshop: Workshop) -> Side:
    layout = wire(load(NAME))
    by_ticks = sum(box.is_by_ticks for box in layout.mailboxes)
    return [
        f"{by_ticks} of the {len(layout.mailboxes)} mailboxes of {code(NAME)} show a message at a"
        " tick that is fixed in advance: at the end of the cycle in which it was written, however"
        " early that was. What a level reads then depends on ticks alone. We predict equal"
        " digests, which cover every message, in two runs in lockstep and in a run in real time,"
        " as long as no deadline is missed; and no difference before the first miss. Each run"
        f" simulates {SECONDS:g} s; there are at most {ATTEMPTS} in real time, until one is without"
        " a miss."
    ]


def _determined_tested(findings: Findings) -> Assessment:
    runs = findings.of(DETERMINISM).runs
    head = (
        "run",
        "mode",
        "wall clock, s",
        "messages",
        "misses",
        "first at tick",
        "diverges at tick",
        "first in",
        "digest",
    )
    side: Side = [Columns(head, [_run_row(run) for run in runs])]
    lockstep = [run for run in runs if run.mode == LOCKSTEP]
    real = [run for run in runs if run.mode == REAL]
    reference = lockstep[0].digest
    if any(run.digest != reference for run in lockstep):
        return Assessment(side, Ruling.FAILS, "Two runs in lockstep differ.")
    if not all(_is_explained(run) for run in real):
        return Assessment(
            side, Ruling.FAILS, "A run in real time diverged before it had missed a deadline."
        )
    if any(run.first_miss is None and run.digest == reference for run in real):
        why = (
            "Lockstep twice and a run in real time without a miss wrote the same messages, bit"
            " for bit."
        )
        if len(real) > 1:
            why += " Runs that missed deadlines diverged no earlier than at the first miss."
        return Assessment(side, Ruling.HOLDS, why)
    why = (
        "Lockstep twice wrote the same messages. This machine kept no run in real time free of"
        " misses; none diverged before its first miss, and every miss is on record."
    )
    return Assessment(side, Ruling.BOUNDED, why)


def _is_explained(run: ComparedRun) -> bool:
    """Return whether a run diverges from the reference only after it has missed a deadline."""
    if run.difference is None:
        return True
    return run.first_miss is not None and run.first_miss <= run.difference.tick


def _run_row(run: ComparedRun) -> Row:
    difference = run.difference
    differs_at = None if difference is None else difference.tick
    differs_in = None if difference is None else code(difference.mailbox)
    return (
        text(run.run),
        run.mode,
        f"{run.wall_s:.2f}",
        run.messages,
        run.missed,
        run.first_miss,
        differs_at,
        differs_in,
        code(run.digest[:12]),
    )


def _costs(workshop: Workshop) -> Side:
    config = load(NAME)
    rack = rack_timing(config, wire(config))
    rows = []
    for name, level in rack.levels.items():
        share = 100 * level.communication_ns / (level.communication_ns + level.execution_ns)
        rows.append(
            (
                name,
                f"{level.execution_ns * 1e-6:g}",
                f"{level.communication_ns * 1e-6:g}",
                f"{share:.0f}",
            )
        )
    head = ("level", "t<sub>exec</sub>", "t<sub>comm</sub>", "communication, % of both")
    loads = ", ".join(f"core {core}: {100 * load_:.0f} %" for core, load_ in rack.loads.items())
    caption = f"Worst case, by the budgets. Loads of the processors, planners included: {loads}."
    return [Columns(head, rows, caption)]


def _costs_tested(findings: Findings) -> Assessment:
    """Compare the processor time of communication with what the less loaded processor takes off the
    other one."""
    found = findings.of(NASREM)
    rows = []
    communicates = 0.0
    for level, task in found.executors.items():
        parts = task.phases
        exec_us = parts.process.p50
        comm_us = parts.exchange.p50 + parts.read.p50 + parts.write.p50
        rate_hz = 1e3 / task.slice_ms
        communicates += comm_us * rate_hz * 1e-6
        rows.append(
            (
                level,
                f"{exec_us:.0f}",
                f"{comm_us:.0f}",
                f"{100 * comm_us / (comm_us + exec_us):.0f}",
                f"{comm_us * rate_hz * 1e-3:.1f}",
            )
        )
    head = (
        "level",
        "t<sub>exec</sub>, us",
        "t<sub>comm</sub>, us",
        "communication, % of both",
        "communication, ms a second",
    )
    loads = ", ".join(f"core {core}: {1e3 * load_:.0f}" for core, load_ in found.loads.items())
    caption = f"Medians of a run. Processor time of all tasks, ms a second: {loads}."
    side: Side = [Columns(head, rows, caption)]
    if len(found.loads) < 2:
        return Assessment(
            side, Ruling.UNTESTABLE, "All boards ran on one processor: there is nothing to save."
        )
    saved = min(found.loads.values())
    words = (
        f"Communication takes {1e3 * communicates:.0f} ms of processor time a second; the second"
        f" processor takes {1e3 * saved:.0f} ms a second off the first."
    )
    ruling = Ruling.HOLDS if communicates < saved else Ruling.BOUNDED
    return Assessment(side, ruling, words)


ABSTRACT = Chapter(
    "abstract",
    (Statement("determinism", (DETERMINISM,), _determined, _determined_tested),),
)
INTRODUCTION = Chapter(
    "1",
    (Statement("communication", (NASREM,), _costs, _costs_tested),),
)
