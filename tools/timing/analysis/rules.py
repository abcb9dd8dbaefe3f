"""The equations that a cycle can break by itself, put to all cycles of a task at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.levels.timing import trace_times
from rack.levels.timing.equations import (
    Relation,
    coupling_may_be_tight,
    executes_in_time,
    fits_cycle,
    leaves_time_to_plan,
    plan_fits_loose,
    plan_fits_tight,
    residual_is_left,
)
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.verdicts import LOOSE_PLAN, RESPONSE_TIME
from rack.tools.recording.cycles import Cycles


@dataclass(frozen=True)
class Rule:
    """An equation put to all cycles of a task: each side of `relation` has shape (cycles,), or is
    one number for all.

    Sides are ns, or parts of a cycle where `unit` is "1".
    """

    equation: str
    relation: Relation
    unit: str = "ns"


def rules_for(name: str, found: Mapping[str, Cycles], rack: RackTiming) -> list[Rule]:
    """Return the equations put to the cycles of a task; `found` are the cycles of the run, by
    task."""
    if found[name].task.role == "executor":
        return list(_executor_rules(name, found, rack))
    return list(_planner_rules(name, found, rack))


def _executor_rules(name: str, found: Mapping[str, Cycles], rack: RackTiming) -> Iterator[Rule]:
    cycles = found[name]
    board = cycles.task.board
    period_ns = cycle_ns(rack, cycles.task)
    execution = cycles.process_ns
    communication = cycles.communication_ns
    yield Rule("3.1", _put(fits_cycle, execution, communication, period_ns))
    yield Rule(
        "3.4", _put(executes_in_time, execution, round(rack.longest_cycles[board] * rack.tick_ns))
    )
    yield Rule("3.6", _put(residual_is_left, period_ns - execution - communication))
    yield Rule("3.7", _put(Relation, steps_ns(cycles, rack), "=", period_ns))
    if rack.boards[board].coupling == "tight":
        update = _updates_ns(cycles, found.get(f"{name}.planner"))
        yield Rule(
            "3.9",
            _put(
                leaves_time_to_plan,
                execution,
                communication + update,
                rack.context_switch_ns,
                period_ns,
            ),
        )
        yield Rule(
            "3.10",
            _put(coupling_may_be_tight, cycles.exchange_ns + update, period_ns, rack.small_share),
            "1",
        )
    yield from _deadline(cycles, rack)


def _planner_rules(name: str, found: Mapping[str, Cycles], rack: RackTiming) -> Iterator[Rule]:
    cycles = found[name]
    task = cycles.task
    executor = found.get(cycles.task.board)
    if rack.boards[task.board].coupling != "tight":
        yield Rule(
            LOOSE_PLAN,
            _put(plan_fits_loose, cycles.used_ns, task.within_cycles, cycle_ns(rack, task)),
        )
    elif executor is not None:
        left = _left_to_plan_ns(cycles, executor, rack)
        yield Rule(
            "3.8",
            _put(plan_fits_tight, cycles.used_ns, task.within_cycles, left, rack.context_switch_ns),
        )
    yield from _deadline(cycles, rack)


def _deadline(cycles: Cycles, rack: RackTiming) -> Iterator[Rule]:
    if not rack.is_lockstep:
        yield Rule(
            RESPONSE_TIME,
            _put(Relation, response_ns(cycles, rack), "<=", slice_ns(rack, cycles.task)),
        )


def cycle_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return R_i of a task's level."""
    return rack.boards[task.board].every * rack.tick_ns


def slice_ns(rack: RackTiming, task: TaskSpec) -> int:
    """Return the time available to one cycle of a task; d R_i, the time slice, of a planner."""
    return task.slice * rack.tick_ns


def response_ns(cycles: Cycles, rack: RackTiming) -> np.ndarray:
    """Return the time from the release to the end of each cycle, shape (n,).

    A cycle whose message came too late, as its trace says, has missed its deadline whenever it
    ended.
    """
    least = np.where(trace_times.is_missed(cycles.rows), slice_ns(rack, cycles.task) + 1, 0)
    return np.asarray(np.maximum(trace_times.response_ns(cycles.rows), least))


def steps_ns(cycles: Cycles, rack: RackTiming) -> np.ndarray:
    """Return the time from the previous release to that of each cycle, t_(k+1) - t_k of eq. 3.7,
    shape (n,).

    It follows from the releases skipped as traced: a restart, or a row lost by the recorder, is not
    a skipped release.
    """
    return np.asarray((1 + trace_times.skipped(cycles.rows)) * cycle_ns(rack, cycles.task))


def _updates_ns(executor: Cycles, plans: Cycles | None) -> np.ndarray:
    """Return the time spent on updating the plan in each cycle of an executor, shape (n,)."""
    updates = np.zeros(len(executor.rows), np.int64)
    if plans is not None:
        cycle = (
            np.searchsorted(executor.rows["release_ns"], plans.rows["process_ns"], side="right") - 1
        )
        np.add.at(updates, np.maximum(cycle, 0), plans.write_ns)
    return updates


def _left_to_plan_ns(plans: Cycles, executor: Cycles, rack: RackTiming) -> np.ndarray:
    """Return the mean residual of the executor's cycles within each plan's slice, shape (plans,).

    A cycle that the executor skipped counts with a residual of 0.
    """
    residual = cycle_ns(rack, executor.task) - executor.used_ns
    before = np.concatenate(([0], np.cumsum(residual)))
    first = plans.rows["tick"]
    last = first + plans.task.slice
    begin, end = (np.searchsorted(executor.rows["tick"], ticks) for ticks in (first, last))
    # A plan at the end of the run is compared with the fewer cycles that it had.
    cycles = np.clip(
        (executor.rows["tick"][-1] - first) // executor.task.every + 1, 1, plans.task.within_cycles
    )
    return np.asarray((before[end] - before[begin]) / cycles)


def _put(equation: Callable[..., Relation], *numbers: Any) -> Relation:
    """Put an equation to all cycles at once: its arithmetic works on arrays as well."""
    return equation(*numbers)
