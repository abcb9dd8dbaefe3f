"""The equations that a cycle can break by itself, put to all cycles of a task at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rack.backplane.trace import SKIPPED_SHIFT, Flag
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
from rack.levels.timing.verdicts import LOOSE_PLAN, RESPONSE_TIME
from rack.tools.analysis.cycles import Cycles
from rack.tools.analysis.model import Model


@dataclass(frozen=True)
class Rule:
    """An equation put to all cycles of a task: a side of `relation` is of shape (cycles,), or one for all of them.

    It is in ns, or in parts of a cycle where `unit` is "1".
    """

    equation: str
    relation: Relation
    unit: str = "ns"


def rules_for(name: str, found: Mapping[str, Cycles], model: Model) -> list[Rule]:
    """Return the equations put to the cycles of a task, of all that `cycles_of` found."""
    is_executor = found[name].task.role == "executor"
    return list(_executor_rules(name, found, model) if is_executor else _planner_rules(name, found, model))


def _executor_rules(name: str, found: Mapping[str, Cycles], model: Model) -> Iterator[Rule]:
    cycles = found[name]
    board, cycle_ns = cycles.task.board, model.cycle_ns(cycles.task)
    execution, communication = cycles.process_ns, cycles.communication_ns
    yield Rule("3.1", _put(fits_cycle, execution, communication, cycle_ns))
    yield Rule("3.4", _put(executes_in_time, execution, model.longest_cycle_ns(cycles.task)))
    yield Rule("3.6", _put(residual_is_left, cycle_ns - execution - communication))
    yield Rule("3.7", _put(Relation, steps_ns(cycles, model), "=", cycle_ns))
    if board in model.tight:
        update = _updates_ns(cycles, found.get(f"{name}.planner"))
        yield Rule("3.9", _put(leaves_time_to_plan, execution, communication + update, model.switch_ns, cycle_ns))
        yield Rule("3.10", _put(coupling_may_be_tight, cycles.exchange_ns + update, cycle_ns, model.small_share), "1")
    yield from _deadline(cycles, model)


def _planner_rules(name: str, found: Mapping[str, Cycles], model: Model) -> Iterator[Rule]:
    cycles = found[name]
    task, executor = cycles.task, found.get(cycles.task.board)
    if task.board not in model.tight:
        yield Rule(LOOSE_PLAN, _put(plan_fits_loose, cycles.used_ns, task.within_cycles, model.cycle_ns(task)))
    elif executor is not None:
        left = _left_to_plan_ns(cycles, executor, model)
        yield Rule("3.8", _put(plan_fits_tight, cycles.used_ns, task.within_cycles, left, model.switch_ns))
    yield from _deadline(cycles, model)


def _deadline(cycles: Cycles, model: Model) -> Iterator[Rule]:
    if not model.is_lockstep:
        yield Rule(RESPONSE_TIME, _put(Relation, response_ns(cycles, model), "<=", model.slice_ns(cycles.task)))


def response_ns(cycles: Cycles, model: Model) -> np.ndarray:
    """Return how long after its release each cycle ended, shape (n,).

    One whose message came too late, as the trace says, has missed its deadline whenever it ended.
    """
    rows = cycles.rows
    missed = (rows["flags"] & Flag.MISSED) > 0
    least = np.where(missed, model.slice_ns(cycles.task) + 1, 0)
    return np.asarray(np.maximum(rows["end_ns"] - rows["release_ns"], least))


def steps_ns(cycles: Cycles, model: Model) -> np.ndarray:
    """Return how long behind the release before each cycle was released, t_(k+1) - t_k of eq. 3.7, shape (n,).

    By what the trace says was skipped: a new process begins anew, and a row that the recorder lost is no cycle lost.
    """
    return np.asarray((1 + (cycles.rows["flags"] >> SKIPPED_SHIFT)) * model.cycle_ns(cycles.task))


def _updates_ns(executor: Cycles, plans: Cycles | None) -> np.ndarray:
    """Return how long the plan was updated in each of an executor's cycles, shape (n,)."""
    updates = np.zeros(len(executor.rows), np.int64)
    if plans is not None:
        cycle = np.searchsorted(executor.rows["release_ns"], plans.rows["process_ns"], side="right") - 1
        np.add.at(updates, np.maximum(cycle, 0), plans.write_ns)
    return updates


def _left_to_plan_ns(plans: Cycles, executor: Cycles, model: Model) -> np.ndarray:
    """Return what the executor left of a cycle, in the middle of those of each plan's slice, shape (plans,).

    A cycle that the executor skipped left nothing: it was late.
    """
    residual = model.cycle_ns(executor.task) - executor.used_ns
    before = np.concatenate(([0], np.cumsum(residual)))
    first = plans.rows["tick"]
    begin, end = (np.searchsorted(executor.rows["tick"], ticks) for ticks in (first, first + _slice_ticks(plans)))
    # A plan at the end of the run has fewer cycles, and is held against those.
    cycles = np.clip((executor.rows["tick"][-1] - first) // executor.task.every + 1, 1, plans.task.within_cycles)
    return np.asarray((before[end] - before[begin]) / cycles)


def _slice_ticks(cycles: Cycles) -> int:
    return cycles.task.every * cycles.task.within_cycles


def _put(equation: Callable[..., Relation], *numbers: Any) -> Relation:
    """Put an equation to all cycles: plain arithmetic takes arrays of them as well as one."""
    return equation(*numbers)
