"""A rack as the equations see it, and the equations put to all cycles of a task at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import NS_PER_MS, is_critical, tick_ns
from rack.levels.timing import trace_times
from rack.levels.timing.equations import (
    coupling_may_be_tight,
    executes_in_time,
    fits_cycle,
    leaves_time_to_plan,
    plan_fits_loose,
    plan_fits_tight,
    residual_is_left,
)
from rack.levels.timing.relation import Relation
from rack.tools.runs.cycles import Cycles
from rack.tools.timing.prediction import hierarchy, longest_cycles
from rack.tools.timing.verdicts import LOOSE_PLAN, RESPONSE_TIME


@dataclass(frozen=True)
class Model:
    """A rack as the equations see it. `tick_ns` is one tick of the wall clock; in lockstep, of simulated time.

    `levels` are the boards of the hierarchy; `cycles` and `longest_cycles` (R_max) are ticks. `tight` are the boards
    that share their processor with their planner, `critical` those of them whose plan update is a critical section.
    """

    is_lockstep: bool
    tick_ns: int
    cycles: dict[str, int]
    longest_cycles: dict[str, float]
    levels: tuple[str, ...]
    tight: frozenset[str]
    critical: frozenset[str]
    switch_ns: float
    small_share: float

    @classmethod
    def of(cls, config: RackConfig, layout: Layout) -> Model:
        """Return the model of a config and its layout."""
        tight = frozenset(name for name, board in config.board.items() if board.coupling == "tight")
        return cls(
            is_lockstep=config.clock.mode == "lockstep",
            tick_ns=tick_ns(config),
            cycles={name: layout.task(name).every for name in config.board},
            longest_cycles=longest_cycles(config),
            levels=hierarchy(config),
            tight=tight,
            critical=frozenset(name for name in tight if is_critical(config, layout, name)),
            switch_ns=config.timing.context_switch_ms * NS_PER_MS,
            small_share=config.timing.small_share,
        )

    def cycle_ns(self, task: TaskSpec) -> int:
        """Return R_i of a task's level."""
        return self.cycles[task.board] * self.tick_ns

    def slice_ns(self, task: TaskSpec) -> int:
        """Return the time available to one cycle of a task; d R_i, the time slice, of a planner."""
        return task.every * task.within_cycles * self.tick_ns

    def longest_cycle_ns(self, task: TaskSpec) -> int:
        """Return R_max of eq. 3.4."""
        return round(self.longest_cycles[task.board] * self.tick_ns)


@dataclass(frozen=True)
class Rule:
    """An equation put to all cycles of a task: each side of `relation` has shape (cycles,), or is one number for all.

    Sides are ns, or parts of a cycle where `unit` is "1".
    """

    equation: str
    relation: Relation
    unit: str = "ns"


def rules_for(name: str, found: Mapping[str, Cycles], model: Model) -> list[Rule]:
    """Return the equations put to the cycles of a task; `found` are the cycles of the run, by task."""
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
    """Return the time from the release to the end of each cycle, shape (n,).

    A cycle whose message came too late, as its trace says, has missed its deadline whenever it ended.
    """
    least = np.where(trace_times.is_missed(cycles.rows), model.slice_ns(cycles.task) + 1, 0)
    return np.asarray(np.maximum(trace_times.response_ns(cycles.rows), least))


def steps_ns(cycles: Cycles, model: Model) -> np.ndarray:
    """Return the time from the previous release to that of each cycle, t_(k+1) - t_k of eq. 3.7, shape (n,).

    It follows from the releases skipped as traced: a restart, or a row lost by the recorder, is not a skipped release.
    """
    return np.asarray((1 + trace_times.skipped(cycles.rows)) * model.cycle_ns(cycles.task))


def _updates_ns(executor: Cycles, plans: Cycles | None) -> np.ndarray:
    """Return the time spent on updating the plan in each cycle of an executor, shape (n,)."""
    updates = np.zeros(len(executor.rows), np.int64)
    if plans is not None:
        cycle = np.searchsorted(executor.rows["release_ns"], plans.rows["process_ns"], side="right") - 1
        np.add.at(updates, np.maximum(cycle, 0), plans.write_ns)
    return updates


def _left_to_plan_ns(plans: Cycles, executor: Cycles, model: Model) -> np.ndarray:
    """Return the mean residual of the executor's cycles within each plan's slice, shape (plans,).

    A cycle that the executor skipped counts with a residual of 0.
    """
    residual = model.cycle_ns(executor.task) - executor.used_ns
    before = np.concatenate(([0], np.cumsum(residual)))
    first = plans.rows["tick"]
    last = first + plans.task.every * plans.task.within_cycles
    begin, end = (np.searchsorted(executor.rows["tick"], ticks) for ticks in (first, last))
    # A plan at the end of the run is compared with the fewer cycles that it had.
    cycles = np.clip((executor.rows["tick"][-1] - first) // executor.task.every + 1, 1, plans.task.within_cycles)
    return np.asarray((before[end] - before[begin]) / cycles)


def _put(equation: Callable[..., Relation], *numbers: Any) -> Relation:
    """Put an equation to all cycles at once: its arithmetic works on arrays as well."""
    return equation(*numbers)
