"""NASREM: its whole task in real time, with every equation put to the run; the same messages in
lockstep and in real time; losses and how soon they are over; and moves by a promised time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
from pydantic import TypeAdapter

from rack.boards.config import load
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.trace_times import counts, gaps_ns
from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Failure
from rack.tools.faults.judge import Judgement, faults
from rack.tools.lab.benches.observed import Recorded
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.lab.reproduction.experiments.tasks import TaskRun, task_run
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.divergence import Difference, first_difference
from rack.tools.recording.history import misses
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import Analysis, slice_ns

NAME = "nasrem"
TASK_S = 34.0
"""About how long its whole task takes in real time."""
US = 1e-3
MS = 1e-6
COMPARED_S = 6.0
"""Simulated time of runs that are compared, long enough for the arm to move."""
LAUNCH_S = 3.0
ATTEMPTS = 3
"""Most compared runs in real time: one without a missed deadline is wanted."""
ABOVE_M = 0.12
"""A is so far above the place to which the rack's own program takes its first object."""
TOO_EARLY = 0.5
"""Part of the time in soft time that is demanded first."""
GOTO_S = 32.0


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
    failing = {pair.measured.key for pair in analysis.mostly if pair.measured and pair.fails}
    ticks = result.outcome.ticks
    layout = recording.layout
    return NasremRun(
        **vars(task_run(result, recording)),
        ticks=ticks,
        verdicts=tuple(
            MeasuredVerdict(pair.measured, pair.measured.key not in failing)
            for pair in analysis.pairs
            if pair.measured
        ),
        executors={
            name: _executor(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
            if cycles.task.role == "executor"
        },
        due={name: -(-ticks // layout.mailbox(name).every) for name in recording.mailboxes},
    )


NASREM = Experiment(NAME, "nasrem in real time, its whole task", TASK_S, NasremRun, _measure)


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


@dataclass(frozen=True)
class ComparedRun:
    """The digest of a run, the tick of its first missed deadline, and where it diverges from the
    first run.
    """

    mode: str
    digest: str
    first_miss: int | None
    difference: Difference | None


def _compare_modes(workshop: Workshop) -> tuple[ComparedRun, ...]:
    """Return runs in lockstep, then in real time."""
    first, second = (_recorded(workshop, f"{NAME}-lockstep-{k}", "lockstep") for k in (1, 2))
    runs = [_compared(first, None), _compared(second, first.recording)]
    for attempt in range(1, ATTEMPTS + 1):
        run = _recorded(workshop, f"{NAME}-realtime-{attempt}", "realtime")
        runs.append(_compared(run, first.recording))
        if runs[-1].first_miss is None:
            break
    return tuple(runs)


DETERMINISM = Experiment(
    "determinism",
    "nasrem twice in lockstep, then in real time",
    2 * LAUNCH_S + 2 * (COMPARED_S + LAUNCH_S),
    tuple[ComparedRun, ...],
    _compare_modes,
    cores=0,
)


def _recorded(workshop: Workshop, label: str, mode: str) -> Recorded:
    return workshop.run(label, workshop.config(NAME, [f"clock.mode={mode}"]), COMPARED_S)


def _compared(run: Recorded, reference: Recording | None) -> ComparedRun:
    result, recording = run
    return ComparedRun(
        mode=recording.rack_config.clock.mode,
        digest=result.outcome.digest,
        first_miss=min((miss["tick"] for miss in misses(recording)), default=None),
        difference=None if reference is None else first_difference(recording, reference),
    )


@dataclass(frozen=True)
class LossesRun:
    """A run with a script of faults: each fault, and whether the run worked."""

    faults: tuple[Judgement, ...]
    worked: bool


def _measure_losses(script: str, workshop: Workshop) -> LossesRun:
    """Run the rack's whole task in real time with a script of faults."""
    result, recording = workshop.run(script, workshop.config(NAME, (), script))
    found = faults(recording.events, recording.layout)["faults"]
    return LossesRun(TypeAdapter(tuple[Judgement, ...]).validate_python(found), result.worked)


KILLS, SENSORS = (
    Experiment(script, about, TASK_S, LossesRun, partial(_measure_losses, script))
    for script, about in (
        ("kill-each-board", "every board of nasrem killed once"),
        ("bad-sensors", "the sensors of nasrem failing one way after another"),
    )
)


@dataclass(frozen=True)
class GotoRun:
    """A run of GOTO A, GOTO B, s.

    Attributes:
        by_s: Time by which A was demanded; None for soft time.
        done_s: End of the cycle in which the task level reported A done; None if it never did.
        earliest_s: Time that a refusal named instead; None without a refusal.
        moved: Whether the arm did a move.
    """

    by_s: float | None
    done_s: float | None
    earliest_s: float | None
    moved: bool


@dataclass(frozen=True)
class GotoRuns:
    """A by a time that is too early, and by one that can be met."""

    early: GotoRun
    met: GotoRun


def _measure_goto(workshop: Workshop) -> GotoRuns:
    soft = _goto(workshop, "goto", None)
    if soft.done_s is None:
        raise Failure("goto without a time was not done")
    early = _goto(workshop, "goto-too-early", round(TOO_EARLY * soft.done_s, 2))
    # Without a refusal, the time of the first run is demanded.
    by_s = ceil((early.earliest_s or soft.done_s) * 10) / 10
    return GotoRuns(early, _goto(workshop, "goto-by", by_s))


DEADLINE = Experiment("goto", "goto in soft time, and by a time", GOTO_S, GotoRuns, _measure_goto)


def _goto(workshop: Workshop, label: str, by_s: float | None) -> GotoRun:
    """Run GOTO A, above the goal of the first object that the program moves, then GOTO B, the
    start.
    """
    x, y, z = next(action["to"] for action in load(NAME).task["action"] if "to" in action)
    by = "" if by_s is None else f", by = {by_s!r}"
    place = [x, y, round(z + ABOVE_M, 6)]
    program = f'task.action=[{{ do = "goto", position = {place}{by} }}, {{ do = "home" }}]'
    recording = workshop.run(label, workshop.config(NAME, [program])).recording
    done, ticks, moves = (
        recording.signal("task.status", name) for name in ("action", "visible_at", "moves_done")
    )
    times_s = ticks[done >= 1] * recording.layout.clock_ns * 1e-9
    earliest_s = np.zeros(0)
    if "task.plan" in recording.mailboxes:
        earliest_s = recording.signal("task.plan", "earliest")
    return GotoRun(
        by_s=by_s,
        done_s=next(iter(times_s.tolist()), None),
        earliest_s=next(iter(earliest_s[earliest_s > 0].tolist()), None),
        moved=bool(moves.any()),
    )
