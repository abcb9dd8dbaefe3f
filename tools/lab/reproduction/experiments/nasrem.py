"""The NASREM rack in real time, its whole task, with every equation put to the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydantic import TypeAdapter

from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import distribution, gaps_ns
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.experiment import (
    Document,
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import Analysis
from rack.tools.timing.analysis.document import task_document

NAME = "nasrem"
LASTS_S = 34.0
US = 1e-3
MS = 1e-6


@dataclass(frozen=True)
class Percentiles:
    """Median and longest of the times of a run."""

    p50: float
    max: float


@dataclass(frozen=True)
class Phases:
    """The parts of an executor's cycle in which it communicates, C, R and W, us."""

    exchange: Percentiles
    read: Percentiles
    write: Percentiles


@dataclass(frozen=True)
class MeasuredVerdict:
    """A verdict on the worst cycle of a run, and whether the equation holds in most cycles."""

    measured: EquationVerdict
    mostly: bool


@dataclass(frozen=True)
class ExecutorCycles:
    """The cycles of an executor, with times in ms."""

    cycles: int
    start_up: int
    stalled: int
    missed: int
    skipped: int
    slice_ms: float
    largest_gap_ms: float
    phases: Phases


@dataclass(frozen=True)
class MailboxTraffic:
    """What passed through a mailbox, next to what the ticks of its writer demand."""

    mailbox: str
    due: int
    messages: int


@dataclass(frozen=True)
class WayResponse:
    """The response of a hierarchy one way, ms; None: nothing went all the way."""

    measured_ms: Percentiles | None
    beyond: tuple[Document, ...]


@dataclass(frozen=True)
class SystemResponse:
    """The response of a hierarchy, down and up, next to equation 3.3, ms."""

    sum_eq_3_3_ms: float
    command: WayResponse
    status: WayResponse


@dataclass(frozen=True)
class NasremRun:
    """What a run in real time left."""

    ended: str
    ticks: int
    verdicts: tuple[MeasuredVerdict, ...]
    executors: dict[str, ExecutorCycles]
    response: SystemResponse
    mailboxes: tuple[MailboxTraffic, ...]


def _run(workshop: Workshop) -> NasremRun:
    need_real_time()
    result, recording = workshop.run(NAME, workshop.config(NAME))
    analysis = Analysis.of(recording)
    analysis = replace(analysis, config=analysis.config.model_copy(update={"name": NAME}))
    ticks = result.outcome.ticks
    return NasremRun(
        ended=result.outcome.cause,
        ticks=ticks,
        verdicts=tuple(_verdicts(analysis)),
        executors={
            name: _executor(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
            if cycles.task.role == "executor"
        },
        response=TypeAdapter(SystemResponse).validate_python(analysis.response),
        mailboxes=tuple(_mailbox(recording, name, ticks) for name in recording.mailboxes),
    )


NASREM = Experiment(
    NAME,
    "nasrem in real time, its whole task",
    LASTS_S,
    NasremRun,
    _run,
)


def _verdicts(analysis: Analysis) -> Iterator[MeasuredVerdict]:
    """Yield every equation on every subject, as measured in the worst cycle."""
    failing = {pair.measured.key for pair in analysis.mostly if pair.measured and pair.fails}
    for pair in analysis.pairs:
        if pair.measured:
            yield MeasuredVerdict(pair.measured, pair.measured.key not in failing)


def _executor(cycles: Cycles, rack: RackTiming) -> ExecutorCycles:
    stamped_ns = {
        "exchange": cycles.exchange_ns,
        "read": cycles.read_ns,
        "write": cycles.write_ns,
    }
    phases = {
        name: distribution(times_ns[cycles.is_judged] * US) for name, times_ns in stamped_ns.items()
    }
    # Of all cycles: one that a stall prolonged leaves a gap too.
    gap_ms = float(gaps_ns(cycles.rows).max()) * MS
    document = {**task_document(cycles, rack), "phases": phases, "largest_gap_ms": gap_ms}
    return TypeAdapter(ExecutorCycles).validate_python(document)


def _mailbox(recording: Recording, name: str, ticks: int) -> MailboxTraffic:
    every = recording.layout.mailbox(name).every
    return MailboxTraffic(
        mailbox=name,
        due=-(-ticks // every),
        messages=len(np.unique(recording.signal(name, "serial"))),
    )
