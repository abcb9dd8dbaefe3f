"""A run compared with the timing model: every equation twice, predicted from the budgets and as
measured.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.boards.config import rack_timing
from rack.boards.config.timing import without_interrupts
from rack.boards.timing import trace_times
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.verdicts import LOAD, ORDER, RESPONSE_TIME, EquationVerdict, verdicts
from rack.tools.console.answer import Failure
from rack.tools.recording.cycles import WORST, Cycles, budgets_of, cycles_of, worst_of
from rack.tools.recording.recording import Recording
from rack.tools.timing.measured_response import system_response

MOSTLY = 99.0
"""Percentile for the question whether a level fails in most of its cycles."""
OBSERVED = ("3.2", "3.3", "3.7", RESPONSE_TIME, LOAD)
"""Equations that a run shows directly; the others follow from the times of its levels."""


@dataclass(frozen=True)
class Pair:
    """One equation put to one subject. `predicted` is None without a budget, `measured` if a run
    cannot show it.
    """

    equation: str
    subject: str
    predicted: EquationVerdict | None
    measured: EquationVerdict | None

    @property
    def disagrees(self) -> bool:
        """Whether the run contradicts the prediction."""
        if self.predicted is None or self.measured is None:
            return False
        # The measured load of an overloaded core stays below 1.
        is_full = self.equation == LOAD and not self.predicted.holds
        return self.predicted.holds != self.measured.holds and not is_full

    @property
    def fails(self) -> bool:
        """Whether the equation failed in the run."""
        return self.measured is not None and not self.measured.holds


@dataclass(frozen=True)
class Analysis:
    """A run compared with the timing model.

    `predicted` is the rack with the budgets of its config, `measured` the rack with those of the
    run. `cycles` are by task, `loads` by core, as parts of its time. `pairs` are of the
    `percentile`, `mostly` of the longest of `MOSTLY` in 100 cycles: a level that does not fit fails
    in most of its cycles, a machine that stalls now and then does not.
    """

    recording: Recording
    percentile: float
    cycles: Mapping[str, Cycles]
    loads: Mapping[int, float]
    predicted: RackTiming
    measured: RackTiming
    pairs: tuple[Pair, ...]
    mostly: tuple[Pair, ...]

    @classmethod
    def of(
        cls,
        recording: Recording,
        percentile: float = WORST,
        progress: Callable[[float], None] = lambda part: None,
    ) -> Analysis:
        """Analyze a recorded run; `progress` takes the part done. Raises `Failure` for an empty or
        old trace.
        """
        config = recording.rack_config
        layout = recording.layout
        cycles = cycles_of(recording)
        if not cycles:
            raise Failure(
                f"{recording.folder}: no cycle was traced; there is nothing to analyze", 2
            )
        progress(0.4)
        predicted = rack_timing(config, layout)
        loads = core_loads(recording, cycles, predicted)
        meaning = "time used by its tasks"
        used = [
            EquationVerdict(LOAD, f"core {core}", load, "<=", 1.0, meaning, "1")
            for core, load in loads.items()
        ]
        response = system_response(recording)

        def judged(percent: float) -> tuple[RackTiming, tuple[Pair, ...]]:
            budgets = without_interrupts(predicted, budgets_of(cycles, percent))
            rack = rack_timing(config, layout, budgets)
            directly = [*_system(response, rack), *_tasks(cycles, rack, percent), *used]
            derived = [verdict for verdict in verdicts(rack) if verdict.equation not in OBSERVED]
            return rack, tuple(_paired(verdicts(predicted), [*derived, *directly]))

        measured, pairs = judged(percentile)
        progress(0.7)
        _, mostly = judged(min(percentile, MOSTLY))
        return cls(recording, percentile, cycles, loads, predicted, measured, pairs, mostly)

    @property
    def holds(self) -> bool:
        """Whether every equation held in the run."""
        return not any(pair.fails for pair in self.pairs)


def _paired(
    predicted: Sequence[EquationVerdict], measured: Sequence[EquationVerdict]
) -> list[Pair]:
    """Return every equation on every subject, in the order of the equations."""
    sides = [{_key(verdict): verdict for verdict in side} for side in (predicted, measured)]
    pairs = [
        Pair(*key[:2], *(side.get(key) for side in sides))
        for key in dict.fromkeys([*sides[0], *sides[1]])
    ]
    return sorted(pairs, key=lambda pair: ORDER.index(pair.equation))


def _key(verdict: EquationVerdict) -> tuple[str, str, str]:
    # The system's response is judged down and up; eq. 3.7 asks something else of a config than of a
    # run.
    meaning = verdict.meaning if verdict.equation in ("3.2", "3.3", "3.7") else ""
    return verdict.equation, verdict.subject, meaning


def _system(response: Mapping[str, Any] | None, rack: RackTiming) -> Iterator[EquationVerdict]:
    """Yield eq. 3.2 on the longest response of the run, and eq. 3.3 on the sum with its waits for
    the grid.
    """
    if response is None:
        return
    # The response is in simulated time.
    wall_ns = 1e6 * rack.tick_ns / rack.clock_ns
    for found, way in product((response, *response["others"]), ("command", "status")):
        if (times := found[way]["measured_ms"]) is None:
            continue
        bound = found["bound_eq_3_2_ms"] * wall_ns
        limit = "n R_max"
        if rack.response_goal_ns is not None:
            bound = rack.response_goal_ns / rack.speed
            limit = "timing.response_ms"
        longest_ns = times["max"] * wall_ns
        bound_ns = found[way]["bound_ms"] * wall_ns
        meaning = f"R_s of a {way} with its waits for the grid <= {limit}"
        yield EquationVerdict("3.2", found["subject"], longest_ns, "<=", bound, meaning)
        meaning = f"R_s of a {way} <= sum of R_i and of the waits for the grid"
        yield EquationVerdict("3.3", found["subject"], longest_ns, "<=", bound_ns, meaning)


def _tasks(
    found: Mapping[str, Cycles], rack: RackTiming, percentile: float
) -> Iterator[EquationVerdict]:
    for name, cycles in found.items():
        rows = cycles.rows
        if cycles.task.role == "executor":
            every_ns = cycle_ns(rack, cycles.task)
            # By the releases skipped as traced: a restart, or a row lost by the recorder, is not a
            # skipped release.
            steps_ns = (1 + trace_times.skipped(rows)) * every_ns
            step_ns = worst_of(steps_ns[cycles.is_judged], percentile)
            yield EquationVerdict("3.7", name, step_ns, "=", every_ns, "t_(k+1) - t_k = R_i")
        if not rack.is_lockstep:
            deadline_ns = slice_ns(rack, cycles.task)
            # A cycle whose message came too late, as its trace says, has missed its deadline
            # whenever it ended.
            least_ns = np.where(trace_times.is_missed(rows), deadline_ns + 1, 0)
            response_ns = np.maximum(trace_times.response_ns(rows), least_ns)
            worst_ns = worst_of(response_ns[cycles.is_judged], percentile)
            meaning = "measured response <= deadline"
            yield EquationVerdict(RESPONSE_TIME, name, worst_ns, "<=", deadline_ns, meaning)


def core_loads(
    recording: Recording, found: Mapping[str, Cycles], rack: RackTiming
) -> dict[int, float]:
    """Return by core the part of its time that tasks used, without the clock's own.

    An executor counts at all its releases, skipped ones too: so the load of an overloaded core
    exceeds 1.
    """
    first = min(int(rows["tick"][0]) for rows in recording.cycles.values())
    last = max(int(rows["tick"][-1]) for rows in recording.cycles.values())
    lasted_ns = (last - first + 1) * rack.tick_ns
    loads: defaultdict[int, float] = defaultdict(float)
    for name, cycles in found.items():
        used_ns = recording.cycles[name]["processor_ns"]
        if cycles.task.role == "executor":
            loads[cycles.core] += float(used_ns.mean()) / cycle_ns(rack, cycles.task)
        else:
            loads[cycles.core] += int(used_ns.sum()) / lasted_ns
    return dict(sorted(loads.items()))


def cycle_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return R_i of a task's level."""
    return rack.boards[task.board].every * rack.tick_ns


def slice_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return the time available to one cycle of a task; d R_i, the time slice, of a planner."""
    return task.slice * rack.tick_ns
