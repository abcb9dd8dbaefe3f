"""The NASREM rack in real time, its whole task, with every equation put to the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import counts, gaps_ns
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.lab.reproduction.experiments.tasks import TaskRun, task_run
from rack.tools.recording.cycles import Cycles
from rack.tools.timing.analysis.analysis import Analysis, slice_ns

NAME = "nasrem"
LASTS_S = 34.0
US = 1e-3
MS = 1e-6


@dataclass(frozen=True)
class MeasuredVerdict:
    """A verdict on the worst cycle of a run, and whether the equation holds in most cycles."""

    measured: EquationVerdict
    mostly: bool


@dataclass(frozen=True)
class ExecutorCycles:
    """The cycles of an executor: judged ones, those missed or skipped of them, and all that it did.

    `communication_us` is the sum of the medians of C, R and W.
    """

    cycles: int
    missed: int
    done: int
    slice_ms: float
    largest_gap_ms: float
    communication_us: float


@dataclass(frozen=True)
class NasremRun(TaskRun):
    """The results of the run.

    Attributes:
        ticks: Length of the run.
        verdicts: Every equation on every subject.
        executors: Cycles by executor.
        due: Number of messages by mailbox that its writer should have sent.
    """

    ticks: int
    verdicts: tuple[MeasuredVerdict, ...]
    executors: dict[str, ExecutorCycles]
    due: dict[str, int]


def _measure(workshop: Workshop) -> NasremRun:
    result, recording = workshop.run(NAME, workshop.config(NAME))
    analysis = Analysis.of(recording)
    analysis = replace(analysis, config=analysis.config.model_copy(update={"name": NAME}))
    ticks = result.outcome.ticks
    layout = recording.layout
    return NasremRun(
        **vars(task_run(result, recording)),
        ticks=ticks,
        verdicts=tuple(measured_verdicts(analysis)),
        executors={
            name: _executor(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
            if cycles.task.role == "executor"
        },
        due={name: -(-ticks // layout.mailbox(name).every) for name in recording.mailboxes},
    )


NASREM = Experiment(NAME, "nasrem in real time, its whole task", LASTS_S, NasremRun, _measure)


def measured_verdicts(analysis: Analysis) -> Iterator[MeasuredVerdict]:
    """Yield every equation on every subject, as measured in the worst cycle."""
    failing = {pair.measured.key for pair in analysis.mostly if pair.measured and pair.fails}
    for pair in analysis.pairs:
        if pair.measured:
            yield MeasuredVerdict(pair.measured, pair.measured.key not in failing)


def _executor(cycles: Cycles, rack: RackTiming) -> ExecutorCycles:
    judged = cycles.is_judged
    rows = cycles.rows[judged]
    parts_ns = (cycles.exchange_ns, cycles.read_ns, cycles.write_ns)
    return ExecutorCycles(
        cycles=len(rows),
        missed=sum(counts(rows)),
        done=len(cycles.rows),
        slice_ms=slice_ns(rack, cycles.task) * MS,
        # Of all cycles: one that a stall prolonged leaves a gap too.
        largest_gap_ms=float(gaps_ns(cycles.rows).max()) * MS,
        communication_us=sum(float(np.median(part_ns[judged])) for part_ns in parts_ns) * US,
    )
