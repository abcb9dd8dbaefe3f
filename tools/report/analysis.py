"""Compares a run with the timing model: evaluates each equation for budgets and measurements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from rack.backplane.layout import TaskSpec
from rack.boards.config import build_rack_timing
from rack.boards.config.timing import subtract_interrupts
from rack.boards.timing import trace_times
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.verdicts import LOAD, ORDER, RESPONSE_TIME, EquationVerdict, evaluate_rack
from rack.tools.console.answer import Failure
from rack.tools.recording.cycles import (
    WORST_PERCENTILE,
    Cycles,
    compute_budgets,
    compute_percentile,
    read_cycles,
)
from rack.tools.recording.recording import Recording
from rack.tools.timing.measured_response import measure_system_response

MOST_CYCLES_PERCENTILE = 99.0
"""Percentile of the second verdicts. They show failures in more than 1 % of the cycles."""
OBSERVED_EQUATIONS = ("3.2", "3.3", "3.7", RESPONSE_TIME, LOAD)
"""Equations that are evaluated with times observed in the run.

The other equations are computed from the measured processor times of the levels.
"""


@dataclass(frozen=True)
class EquationPair:
    """Predicted and measured verdict on one equation for one subject.

    Attributes:
        equation: Number or name of the equation.
        subject: Level, task, core or chain of levels that the equation is about.
        predicted: Verdict based on the budgets of the config, or None without a budget.
        measured: Verdict based on the run, or None if it cannot be measured.
    """

    equation: str
    subject: str
    predicted: EquationVerdict | None
    measured: EquationVerdict | None

    @property
    def is_contradicted(self) -> bool:
        """True if prediction and measurement disagree on whether the equation holds."""
        if self.predicted is None or self.measured is None:
            return False
        # An overloaded core may have a measured load below 1, which does not contradict a predicted
        # overload.
        is_full = self.equation == LOAD and not self.predicted.holds
        return self.predicted.holds != self.measured.holds and not is_full

    @property
    def is_failed(self) -> bool:
        """True if the equation failed in the run."""
        return self.measured is not None and not self.measured.holds


@dataclass(frozen=True)
class Analysis:
    """Comparison of a run with the timing model.

    The equations are evaluated at two percentiles. A level whose times do not fit into its period
    fails in most of its cycles, while occasional stalls of the machine make a level fail in a
    few cycles.

    Attributes:
        recording: The run.
        percentile: Percentage of a level's cycles that must fulfil an equation.
        cycles: Dictionary from task to its measured cycles.
        loads: Dictionary from core to the used fraction of its time.
        predicted: Timing of the rack with the budgets of its config.
        measured: Timing of the rack with the measured budgets.
        pairs: Verdicts on all equations at `percentile`.
        typical_pairs: Verdicts on all equations at `MOST_CYCLES_PERCENTILE`, or at `percentile` if
            that is lower.
    """

    recording: Recording
    percentile: float
    cycles: Mapping[str, Cycles]
    loads: Mapping[int, float]
    predicted: RackTiming
    measured: RackTiming
    pairs: tuple[EquationPair, ...]
    typical_pairs: tuple[EquationPair, ...]

    @property
    def takes_time(self) -> bool:
        """Whether computing took time: in real time, or on simulated cores."""
        return self.recording.rack_config.takes_time

    @classmethod
    def from_recording(
        cls,
        recording: Recording,
        percentile: float = WORST_PERCENTILE,
        progress: Callable[[float], None] = lambda part: None,
    ) -> Analysis:
        """Analyze a recorded run.

        Args:
            recording: The run.
            percentile: Percentage of a level's cycles that must fulfil an equation.
            progress: Called with the completed fraction, 0 to 1.

        Raises:
            Failure: The recording contains no cycles.
        """
        config = recording.rack_config
        layout = recording.layout
        cycles = read_cycles(recording)
        if not cycles:
            raise Failure(
                f"{recording.folder}: no cycle was traced; there is nothing to analyze", 2
            )
        progress(0.4)
        predicted = build_rack_timing(config, layout)
        loads = compute_core_loads(recording, cycles, predicted)
        meaning = "time used by its tasks"
        used = [
            EquationVerdict(LOAD, f"core {core}", load, "<=", 1.0, meaning, "1")
            for core, load in loads.items()
        ]
        response = measure_system_response(recording)

        def judge_equations(percent: float) -> tuple[RackTiming, tuple[EquationPair, ...]]:
            """Return the measured timing at a percentile, and the verdicts on all equations."""
            budgets = subtract_interrupts(predicted, compute_budgets(cycles, percent))
            rack = build_rack_timing(config, layout, budgets)
            observed = [
                *_judge_response(response, rack),
                *_judge_tasks(cycles, rack, percent, config.takes_time),
                *used,
            ]
            derived = [
                verdict
                for verdict in evaluate_rack(rack)
                if verdict.equation not in OBSERVED_EQUATIONS
            ]
            return rack, tuple(_pair_verdicts(evaluate_rack(predicted), [*derived, *observed]))

        measured, pairs = judge_equations(percentile)
        progress(0.7)
        _, mostly = judge_equations(min(percentile, MOST_CYCLES_PERCENTILE))
        return cls(recording, percentile, cycles, loads, predicted, measured, pairs, mostly)

    @property
    def is_fulfilled(self) -> bool:
        """True if every equation held in the run."""
        return not any(pair.is_failed for pair in self.pairs)


def _pair_verdicts(
    predicted: Sequence[EquationVerdict], measured: Sequence[EquationVerdict]
) -> list[EquationPair]:
    """Pair predicted and measured verdicts on the same equation and subject, sorted by equation."""
    sides = [
        {_build_pair_key(verdict): verdict for verdict in side} for side in (predicted, measured)
    ]
    pairs = [
        EquationPair(*key[:2], *(side.get(key) for side in sides))
        for key in dict.fromkeys([*sides[0], *sides[1]])
    ]
    return sorted(pairs, key=lambda pair: ORDER.index(pair.equation))


def _build_pair_key(verdict: EquationVerdict) -> tuple[str, str, str]:
    """Return the key with which a measured verdict is matched to the predicted one."""
    # Equations 3.2 and 3.3 are evaluated in two directions, and eq. 3.7 has different meanings for
    # a config and for a run. For these, the meanings must be equal as well.
    meaning = verdict.meaning if verdict.equation in ("3.2", "3.3", "3.7") else ""
    return verdict.equation, verdict.subject, meaning


def _judge_response(
    response: Mapping[str, Any] | None, rack: RackTiming
) -> Iterator[EquationVerdict]:
    """Yield verdicts on eqs. 3.2 and 3.3 for the longest measured response in each direction.

    Each chain of levels is evaluated downward (command) and upward (status). The bound of eq. 3.3
    is the sum of the levels' cycles and of the waits for the next cycle of each level.

    Args:
        response: Result of `measure_system_response`. If it is None, nothing is yielded.
        rack: Timing of the rack.
    """
    if response is None:
        return
    # The response is measured in simulated time, but verdicts are in wall-clock time.
    wall_ns = 1e6 * rack.tick_ns / rack.clock_ns
    for chain, direction in product((response, *response["others"]), ("command", "status")):
        if (times := chain[direction]["measured_ms"]) is None:
            continue
        bound = chain["bound_eq_3_2_ms"] * wall_ns
        limit = "n R_max"
        if rack.response_goal_ns is not None:
            bound = rack.response_goal_ns / rack.speed
            limit = "timing.response_ms"
        longest_ns = times["max"] * wall_ns
        bound_ns = chain[direction]["bound_ms"] * wall_ns
        meaning = f"R_s of a {direction} with its waits for the grid <= {limit}"
        yield EquationVerdict("3.2", chain["subject"], longest_ns, "<=", bound, meaning)
        meaning = f"R_s of a {direction} <= sum of R_i and of the waits for the grid"
        yield EquationVerdict("3.3", chain["subject"], longest_ns, "<=", bound_ns, meaning)


def _judge_tasks(
    cycles_by_task: Mapping[str, Cycles], rack: RackTiming, percentile: float, takes_time: bool
) -> Iterator[EquationVerdict]:
    """Yield verdicts on eq. 3.7 for executors, and on the response times of all tasks.

    Response times are evaluated only if computing takes time.

    Args:
        cycles_by_task: Measured cycles of the run.
        rack: Timing of the rack.
        percentile: Percentage of the cycles that must fulfil an equation.
        takes_time: Whether computing took time: in real time, or on simulated cores.
    """
    for name, cycles in cycles_by_task.items():
        rows = cycles.rows
        if cycles.task.role == "executor":
            every_ns = compute_cycle_ns(rack, cycles.task)
            # Use the number of skipped releases in the trace, not gaps between rows: a restart or a
            # row lost by the recorder also causes a gap, but is not a skipped release.
            steps_ns = (1 + trace_times.count_skipped_releases(rows)) * every_ns
            step_ns = compute_percentile(steps_ns[cycles.is_judged], percentile)
            yield EquationVerdict("3.7", name, step_ns, "=", every_ns, "t_(k+1) - t_k = R_i")
        if takes_time:
            deadline_ns = compute_due_ns(rack, cycles.task)
            response_ns = trace_times.compute_response_ns(rows)
            worst_ns = compute_percentile(response_ns[cycles.is_judged], percentile)
            meaning = "measured response <= deadline"
            yield EquationVerdict(RESPONSE_TIME, name, worst_ns, "<=", deadline_ns, meaning)


def compute_core_loads(
    recording: Recording, cycles_by_task: Mapping[str, Cycles], rack: RackTiming
) -> dict[int, float]:
    """Return the fraction of each core's time that its tasks used. The clock board is excluded.

    An executor is counted as if it ran at every release, including skipped ones, so the load of an
    overloaded core exceeds 1.

    Args:
        recording: The run.
        cycles_by_task: Measured cycles of the run.
        rack: Timing of the rack.

    Returns:
        Dictionary from core to load. A load of 1 means that the core was always busy.
    """
    first = min(int(rows["tick"][0]) for rows in recording.cycles.values())
    last = max(int(rows["tick"][-1]) for rows in recording.cycles.values())
    lasted_ns = (last - first + 1) * rack.tick_ns
    loads: defaultdict[int, float] = defaultdict(float)
    for name, cycles in cycles_by_task.items():
        used_ns = recording.cycles[name]["processor_ns"]
        if cycles.task.role == "executor":
            loads[cycles.core] += float(used_ns.mean()) / compute_cycle_ns(rack, cycles.task)
        else:
            loads[cycles.core] += int(used_ns.sum()) / lasted_ns
    return dict(sorted(loads.items()))


def compute_cycle_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return R_i, the time between two cycles of a task's level, in wall-clock ns."""
    return rack.boards[task.board].every * rack.tick_ns


def compute_due_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return the time in wall-clock ns from a release of a task to its deadline.

    For a planner it is d R_i. For an executor it is R_i, or less if it sends interrupts.
    """
    due = task.slice if task.role == "planner" else rack.boards[task.board].due
    return due * rack.tick_ns
