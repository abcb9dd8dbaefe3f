"""The NASREM rack in real time, its whole task, with every equation put to the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from pydantic import TypeAdapter

from rack.boards.config import load
from rack.levels.timing.trace_times import Distribution, distribution
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.experiment import (
    Document,
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.history import counted, misses, steal
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import Analysis, Pair
from rack.tools.timing.analysis.document import task_document

NAME = "nasrem"
LASTS_S = 34.0
US = 1e-3
MS = 1e-6
PHASES = ("exchange", "read", "process", "write")
"""The stamped parts of an executor's cycle: C, R, X, W."""


@dataclass(frozen=True)
class JudgedPair:
    """An equation on a subject: measured in the worst cycle, and whether it holds mostly."""

    equation: str
    subject: str
    measured: EquationVerdict | None
    mostly: bool


@dataclass(frozen=True)
class TaskCycles:
    """The cycles of a task, with times in ms."""

    role: str
    core: int
    cycles: int
    start_up: int
    stalled: int
    missed: int
    skipped: int
    used_ms: Distribution
    deviation_ms: float
    lateness_ms: Distribution
    slice_ms: float
    largest_gap_ms: float | None


@dataclass(frozen=True)
class MailboxTraffic:
    """What passed through a mailbox, next to what the ticks of its writer demand."""

    mailbox: str
    every_ms: float
    due: int
    messages: int


@dataclass(frozen=True)
class BusAccesses:
    """Accesses of a task to the backplane."""

    reads: int
    read_bytes: int
    writes: int
    write_bytes: int


@dataclass(frozen=True)
class WayResponse:
    """The response of a hierarchy one way, ms."""

    bound_ms: float
    measured_ms: Distribution
    beyond: tuple[Document, ...]


@dataclass(frozen=True)
class SystemResponse:
    """The response of a hierarchy, down and up, next to equations 3.2 and 3.3, ms."""

    levels: tuple[str, ...]
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float
    command: WayResponse
    status: WayResponse


@dataclass(frozen=True)
class NasremRun:
    """What a run in real time left: `steal` is the hypervisor's part of a core, percent, `loads`
    the tasks', of 1; `phases` are us."""

    ticks: int
    missed: int
    skipped: int
    steal: dict[str, float]
    pairs: tuple[JudgedPair, ...]
    breaches: dict[str, int]
    tasks: dict[str, TaskCycles]
    phases: dict[str, dict[str, Distribution]]
    loads: dict[int, float]
    response: SystemResponse
    mailboxes: tuple[MailboxTraffic, ...]
    bus: dict[str, BusAccesses]
    pictures: dict[str, str]


def _run(workshop: Workshop) -> NasremRun:
    # It imports matplotlib.
    from rack.tools.timing.analysis.residuals import plot

    need_real_time()
    recording = workshop.run(NAME, workshop.config(NAME), None)
    analysis = Analysis.of(recording)
    analysis = replace(analysis, config=analysis.config.model_copy(update={"name": NAME}))
    stem = workshop.picture("residuals")
    plot(analysis, stem)
    ended = recording.ended
    late, left_out = counted(misses(recording))
    tasks = {
        name: task_document(cycles, analysis.predicted) for name, cycles in analysis.cycles.items()
    }
    drawn = workshop.shown([stem.with_suffix(".png"), stem.with_suffix(".svg")])
    return NasremRun(
        ticks=ended["outcome"]["ticks"],
        missed=late,
        skipped=left_out,
        steal=steal(recording)["percent"],
        pairs=tuple(_pairs(analysis)),
        breaches=_breaches(analysis),
        tasks=TypeAdapter(dict[str, TaskCycles]).validate_python(tasks),
        phases={n: _phases(c) for n, c in analysis.cycles.items() if c.task.role == "executor"},
        loads=dict(analysis.loads),
        response=TypeAdapter(SystemResponse).validate_python(analysis.response),
        mailboxes=tuple(_mailbox(recording, name) for name in recording.mailboxes),
        bus=TypeAdapter(dict[str, BusAccesses]).validate_python(ended["tasks"]),
        pictures={"residuals": drawn},
    )


NASREM = Experiment(
    NAME,
    "nasrem in real time, its whole task",
    LASTS_S,
    NasremRun,
    lambda: {"config": load(NAME).text()},
    _run,
)


def _pairs(analysis: Analysis) -> Iterator[JudgedPair]:
    """Yield every equation on every subject: measured in the worst cycle, and in most."""
    mostly = {_key(pair): pair for pair in analysis.mostly}
    for pair in analysis.pairs:
        found = mostly.get(_key(pair))
        holds = found is None or not found.fails
        yield JudgedPair(pair.equation, pair.subject, pair.measured, holds)


def _key(pair: Pair) -> tuple[str, str, str]:
    shown = pair.measured or pair.predicted
    return pair.equation, pair.subject, shown.meaning if shown is not None else ""


def _breaches(analysis: Analysis) -> dict[str, int]:
    """Return how many cycles broke each equation by their own numbers."""
    broken = chain(
        *({one.equation for one in breach.broken} for breach in analysis.judged_breaches)
    )
    found = list(broken)
    return {equation: found.count(equation) for equation in sorted(set(found))}


def _phases(cycles: Cycles) -> dict[str, Distribution]:
    """Return the parts of an executor's cycle, us."""
    judged = cycles.is_judged
    found = {n: distribution(getattr(cycles, f"{n}_ns")[judged] * US) for n in PHASES}
    return {name: times for name, times in found.items() if times is not None}


def _mailbox(recording: Recording, name: str) -> MailboxTraffic:
    every = recording.layout.mailbox(name).every
    return MailboxTraffic(
        mailbox=name,
        every_ms=every * recording.layout.clock_ns * MS,
        due=-(-recording.ended["outcome"]["ticks"] // every),
        messages=len(np.unique(recording.signal(name, "serial"))),
    )
