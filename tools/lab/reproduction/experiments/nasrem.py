"""Experiments with NASREM.

They apply every equation to a run of its whole task in real time, compare messages in lockstep and
in real time, measure the recovery from losses, and test moves that have a deadline.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
from pydantic import TypeAdapter

from rack.boards.config import load
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.trace_times import compute_gaps_ns, count_misses_and_skips
from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Failure
from rack.tools.faults.judge import Judgement, report_faults
from rack.tools.lab.benches.observed import ObservedRun
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop
from rack.tools.lab.reproduction.experiments.tasks import TaskRun, summarize_task
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.divergence import Difference, find_first_difference
from rack.tools.recording.history import list_misses
from rack.tools.recording.recording import Recording
from rack.tools.report.analysis import Analysis, compute_due_ns

NAME = "nasrem"
TASK_S = 34.0
"""Approximate time of the whole task in real time, s."""
US = 1e-3
MS = 1e-6
COMPARED_S = 6.0
"""Simulated time of runs that are compared, s. It is long enough for the arm to move."""
LAUNCH_S = 3.0
MAX_ATTEMPTS = 3
"""Maximum number of compared runs in real time until one has no missed deadline."""
HEIGHT_ABOVE_M = 0.12
"""Height of A above the place to which the rack's program takes its first object, m."""
TOO_EARLY_FRACTION = 0.5
"""First deadline of GOTO A, as a fraction of the time that it takes without a deadline."""
GOTO_S = 32.0


@dataclass(frozen=True)
class MeasuredVerdict:
    """A verdict on the worst cycle of a run, and whether the equation holds in most cycles."""

    measured: EquationVerdict
    mostly: bool


@dataclass(frozen=True)
class ExecutorCycles:
    """The cycles of an executor.

    Attributes:
        cycles: Number of evaluated cycles.
        missed: Number of evaluated cycles that were missed or skipped.
        done: Number of all cycles.
        slice_ms: Time slice of the executor, ms.
        largest_gap_ms: Largest time between two cycles, ms.
        communication_us: Sum of the medians of C, R and W, us.
    """

    cycles: int
    missed: int
    done: int
    slice_ms: float
    largest_gap_ms: float
    communication_us: float


@dataclass(frozen=True)
class NasremRun(TaskRun):
    """Results of the whole task.

    Attributes:
        ticks: Length of the run.
        verdicts: Verdicts on every equation for every subject.
        executors: Cycles of each executor.
        due: Number of messages that the writer of each mailbox should have sent.
    """

    ticks: int
    verdicts: tuple[MeasuredVerdict, ...]
    executors: dict[str, ExecutorCycles]
    due: dict[str, int]


def _measure_task(workshop: Workshop) -> NasremRun:
    """Run the whole task in real time and apply every equation to the run."""
    result, recording = workshop.run(NAME, workshop.load_config(NAME))
    analysis = Analysis.from_recording(recording)
    failing = {
        pair.measured.key for pair in analysis.typical_pairs if pair.measured and pair.is_failed
    }
    ticks = result.outcome.ticks
    layout = recording.layout
    return NasremRun(
        **vars(summarize_task(result, recording)),
        ticks=ticks,
        verdicts=tuple(
            MeasuredVerdict(pair.measured, pair.measured.key not in failing)
            for pair in analysis.pairs
            if pair.measured
        ),
        executors={
            name: _summarize_executor(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
            if cycles.task.role == "executor"
        },
        due={name: -(-ticks // layout.find_mailbox(name).every) for name in recording.mailboxes},
    )


NASREM = Experiment(NAME, "nasrem in real time, its whole task", TASK_S, NasremRun, _measure_task)


def _summarize_executor(cycles: Cycles, rack: RackTiming) -> ExecutorCycles:
    """Summarise the cycles of an executor."""
    is_judged = cycles.is_judged
    rows = cycles.rows[is_judged]
    parts_ns = (cycles.exchange_ns, cycles.read_ns, cycles.write_ns)
    return ExecutorCycles(
        cycles=len(rows),
        missed=sum(count_misses_and_skips(rows)),
        done=len(cycles.rows),
        slice_ms=compute_due_ns(rack, cycles.task) * MS,
        # Use all cycles, because a cycle that was prolonged by a stall leaves a gap as well.
        largest_gap_ms=float(compute_gaps_ns(cycles.rows).max()) * MS,
        communication_us=sum(float(np.median(part_ns[is_judged])) for part_ns in parts_ns) * US,
    )


@dataclass(frozen=True)
class ComparedRun:
    """A run that is compared with the first one.

    Attributes:
        mode: Clock mode.
        digest: Digest of the run.
        first_miss: Tick of its first missed deadline. None if it has none.
        difference: First difference from the first run. None if both are equal.
    """

    mode: str
    digest: str
    first_miss: int | None
    difference: Difference | None


def _compare_modes(workshop: Workshop) -> tuple[ComparedRun, ...]:
    """Run the rack twice in lockstep, then in real time until a run misses no deadline."""
    first, second = (_record_run(workshop, f"{NAME}-lockstep-{k}", "lockstep") for k in (1, 2))
    runs = [_compare_run(first, None), _compare_run(second, first.recording)]
    for attempt in range(1, MAX_ATTEMPTS + 1):
        run = _record_run(workshop, f"{NAME}-realtime-{attempt}", "realtime")
        runs.append(_compare_run(run, first.recording))
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


def _record_run(workshop: Workshop, label: str, mode: str) -> ObservedRun:
    """Run and record the rack for `COMPARED_S` in a clock mode."""
    return workshop.run(label, workshop.load_config(NAME, [f"clock.mode={mode}"]), COMPARED_S)


def _compare_run(run: ObservedRun, reference: Recording | None) -> ComparedRun:
    """Return the digest of a run, and its first difference from a reference."""
    result, recording = run
    return ComparedRun(
        mode=recording.rack_config.clock.mode,
        digest=result.outcome.digest,
        first_miss=min((miss["tick"] for miss in list_misses(recording)), default=None),
        difference=None if reference is None else find_first_difference(recording, reference),
    )


@dataclass(frozen=True)
class LossesRun:
    """A run with a fault script.

    Attributes:
        faults: Verdict on each fault.
        worked: Whether the task was done.
    """

    faults: tuple[Judgement, ...]
    worked: bool


def _measure_losses(script: str, workshop: Workshop) -> LossesRun:
    """Run the rack's whole task in real time with a fault script."""
    result, recording = workshop.run(script, workshop.load_config(NAME, (), script))
    judgements = report_faults(recording.events, recording.layout)["faults"]
    return LossesRun(TypeAdapter(tuple[Judgement, ...]).validate_python(judgements), result.worked)


KILLS, SENSORS = (
    Experiment(script, about, TASK_S, LossesRun, partial(_measure_losses, script))
    for script, about in (
        ("kill-each-board", "every board of nasrem killed once"),
        ("bad-sensors", "the sensors of nasrem failing one way after another"),
    )
)


@dataclass(frozen=True)
class GotoRun:
    """A run of GOTO A, GOTO B.

    Attributes:
        by_s: Deadline of A, s. None for no deadline.
        done_s: End of the cycle in which the task level reported A done, s. None if it never did.
        earliest_s: Earliest possible time that a refusal named, s. None without a refusal.
        moved: Whether the arm made a move.
    """

    by_s: float | None
    done_s: float | None
    earliest_s: float | None
    moved: bool


@dataclass(frozen=True)
class GotoRuns:
    """Runs of GOTO A with a deadline that is too early, and with one that can be met."""

    early: GotoRun
    met: GotoRun


def _measure_goto(workshop: Workshop) -> GotoRuns:
    """Run GOTO A without a deadline, with one that is too early, and with one that can be met."""
    soft = _run_goto(workshop, "goto", None)
    if soft.done_s is None:
        raise Failure("goto without a time was not done")
    early = _run_goto(workshop, "goto-too-early", round(TOO_EARLY_FRACTION * soft.done_s, 2))
    # If the early deadline was not refused, use the time of the first run as the deadline.
    by_s = ceil((early.earliest_s or soft.done_s) * 10) / 10
    return GotoRuns(early, _run_goto(workshop, "goto-by", by_s))


DEADLINE = Experiment("goto", "goto in soft time, and by a time", GOTO_S, GotoRuns, _measure_goto)


def _run_goto(workshop: Workshop, label: str, by_s: float | None) -> GotoRun:
    """Run GOTO A, GOTO B.

    A is above the goal of the first object that the program moves. B is the start position.

    Args:
        workshop: Folder and settings of the run.
        label: Name of the recording.
        by_s: Deadline of A, s. None for no deadline.
    """
    x, y, z = next(action["to"] for action in load(NAME).task["action"] if "to" in action)
    by = "" if by_s is None else f", by = {by_s!r}"
    place = [x, y, round(z + HEIGHT_ABOVE_M, 6)]
    program = f'task.action=[{{ do = "goto", position = {place}{by} }}, {{ do = "home" }}]'
    recording = workshop.run(label, workshop.load_config(NAME, [program])).recording
    done, ticks, moves = (
        recording.read_signal("task.status", name)
        for name in ("action", "visible_at", "moves_done")
    )
    times_s = ticks[done >= 1] * recording.layout.clock_ns * 1e-9
    earliest_s = np.zeros(0)
    if "task.plan" in recording.mailboxes:
        earliest_s = recording.read_signal("task.plan", "earliest")
    return GotoRun(
        by_s=by_s,
        done_s=next(iter(times_s.tolist()), None),
        earliest_s=next(iter(earliest_s[earliest_s > 0].tolist()), None),
        moved=bool(moves.any()),
    )
