"""Abstract and introduction of the paper: determinism first, and the cost of communication."""

from __future__ import annotations

from rack.boards.config import load, rack_timing, wire
from rack.tools.lab.reproduction.experiments.determinism import (
    ATTEMPTS,
    DETERMINISM,
    NAME,
    SECONDS,
    ComparedRun,
    ComparedRuns,
)
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.nasrem import NASREM, ExecutorCycles, NasremRun
from rack.tools.lab.reproduction.experiments.partition import PARTITION, Partition, Partitions
from rack.tools.lab.reproduction.sections.page import (
    Chapter,
    ClaimVerdict,
    Columns,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
    text,
)
from rack.tools.lab.reproduction.sections.sharing import GROWTH, REPLICATION, SPEEDUP

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


def _determined_measured(workshop: Workshop, found: ComparedRuns) -> Side:
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
    return [Columns(head, [_run_row(run) for run in found.runs])]


def judge_determinism(found: ComparedRuns) -> ClaimVerdict:
    """Compare digests, and where runs diverge with where they first missed a deadline."""
    lockstep = [run for run in found.runs if run.mode == LOCKSTEP]
    real = [run for run in found.runs if run.mode == REAL]
    reference = lockstep[0].digest
    differing = sum(run.digest != reference for run in lockstep)
    early = sum(not _is_explained(run) for run in real)
    equal = sum(run.first_miss is None and run.digest == reference for run in real)
    always = (
        Requirement("runs in lockstep that differ from the first", differing, "=", 0),
        Requirement("runs in real time that diverge before their first miss", early, "=", 0),
    )
    without_miss = Requirement(
        "runs in real time without a miss, with equal digests", equal, ">=", 1
    )
    why = (
        "Lockstep twice and a run in real time without a miss wrote the same messages, bit for bit."
        " No run diverged before its first miss."
    )
    return ruled((*always, without_miss), why, here=always)


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


def _communication_us(task: ExecutorCycles) -> float:
    return task.phases.exchange.p50 + task.phases.read.p50 + task.phases.write.p50


def _costs_measured(workshop: Workshop, found: NasremRun, partitions: Partitions) -> Side:
    rows = []
    for level, task in found.executors.items():
        exec_us = task.phases.process.p50
        comm_us = _communication_us(task)
        rows.append(
            (
                level,
                f"{exec_us:.0f}",
                f"{comm_us:.0f}",
                f"{100 * comm_us / (comm_us + exec_us):.0f}",
                f"{comm_us / task.slice_ms:.1f}",
            )
        )
    head = (
        "level",
        "t<sub>exec</sub>, us",
        "t<sub>comm</sub>, us",
        "communication, % of both",
        "communication, ms a second",
    )
    loads = [
        (one.partition, *(f"{1e3 * one.loads.get(core, 0.0):.0f}" for core in (0, 1)))
        for one in partitions.partitions
    ]
    caption = "Processor time of all tasks, ms a second, on one processor and on two."
    return [
        Columns(head, rows, "Medians of a run."),
        Columns(("planners", "core 0", "core 1"), loads, caption),
    ]


def judge_communication(found: NasremRun, partitions: Partitions) -> ClaimVerdict:
    """Compare the processor time of communication with what a second processor takes off one."""
    tasks = found.executors.values()
    communicates = sum(_communication_us(task) / task.slice_ms for task in tasks)
    loads = {one.partition: one.loads for one in partitions.partitions}
    alone = sum(loads[Partition("tight", 1).name].values())
    saved = 1e3 * (alone - max(loads[Partition("tight", 2).name].values()))
    demand = Requirement(
        "communication, against the time saved", communicates, "<", saved, "ms a second"
    )
    why = (
        "All of communication takes less processor time than the second processor takes off the"
        " busier one, next to a run on one processor."
    )
    return ruled((demand,), why)


ABSTRACT = Chapter(
    "abstract",
    (
        Statement(
            "determinism", (DETERMINISM,), judge_determinism, _determined, _determined_measured
        ),
    ),
)
INTRODUCTION = Chapter(
    "1",
    (
        SPEEDUP,
        GROWTH,
        REPLICATION,
        Statement(
            "communication", (NASREM, PARTITION), judge_communication, _costs, _costs_measured
        ),
    ),
)
