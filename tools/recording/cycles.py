"""The measured cycles of a run, split into unit functions, and budgets for these functions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.boards.timing.tasks import Budget
from rack.boards.timing.trace_times import (
    Occupation,
    compute_unit_times,
    select_plans,
)
from rack.tools.recording.recording import Recording
from rack.tools.recording.stalls import analyze_stalls

START_UP_S = 0.1
"""Simulated time after the start of a process during which its cycles are not evaluated.

A new process touches its memory for the first time and fills its caches. The first cycle of each
level of the default rack takes 2 to 8 times as long as usual; the sixth takes the usual time.
"""
WORST_PERCENTILE = 100.0
"""Percentile required by eq. 3.6: the longest of all cycles."""


@dataclass(frozen=True)
class Cycles:
    """The cycles of one task, oldest first.

    For a planner, only cycles that produced a plan are included. All arrays have shape (n,), and
    all times are processor times. The capital letters are the unit functions of the paper.

    Attributes:
        task: The task.
        core: Core that the task ran on.
        priority: Priority that the task obtained.
        rows: Trace records.
        exchange_ns: C, time to read the plan. 0 for a planner.
        read_ns: R, time to read commands and statuses.
        process_ns: X of an executor, P of a planner.
        write_ns: W of an executor, U of a planner.
        is_judged: False for cycles that are excluded from all verdicts, because a process was
            starting or the core may have been unavailable.
        stalled_count: Number of cycles in which the core may have been unavailable, see
            `analyze_stalls`.
    """

    task: TaskSpec
    core: int
    priority: int
    rows: np.ndarray
    exchange_ns: np.ndarray
    read_ns: np.ndarray
    process_ns: np.ndarray
    write_ns: np.ndarray
    is_judged: np.ndarray
    stalled_count: int

    @property
    def communication_ns(self) -> np.ndarray:
        """Communication time t_comm: the sum of C, R and W, shape (n,)."""
        return np.asarray(self.exchange_ns + self.read_ns + self.write_ns)

    @property
    def used_ns(self) -> np.ndarray:
        """Processor time of all unit functions together, shape (n,)."""
        return np.asarray(self.communication_ns + self.process_ns)


def read_cycles(recording: Recording) -> dict[str, Cycles]:
    """Return a dictionary from task to its cycles. Tasks without recorded cycles are left out."""
    _, absent = analyze_stalls(recording)
    tasks = [task for task in recording.layout.tasks if task.name in recording.cycles]
    places = {task.name: recording.find_core_and_priority(task) for task in tasks}
    spans = {task.name: Occupation.from_records(recording.cycles[task.name]) for task in tasks}
    with_planner = {task.board for task in recording.layout.tasks if task.role == "planner"}
    by_task = {}
    for task in tasks:
        core, priority = places[task.name]
        higher_priority = [
            spans[name]
            for name, (other_core, other_priority) in places.items()
            if other_core == core and other_priority > priority
        ]
        rows = recording.cycles[task.name]
        rows = select_plans(rows) if task.role == "planner" else rows
        if len(rows):
            preempted_by = Occupation.merge(higher_priority)
            exchange_ns, read_ns, process_ns, write_ns = compute_unit_times(rows, preempted_by).T
            if task.board not in with_planner:
                # Without a planner, the check for a new plan counts as reading.
                read_ns = read_ns + exchange_ns
                exchange_ns = np.zeros_like(read_ns)
            settled = _find_settled_cycles(recording, task.name, rows["tick"])
            undisturbed = settled & (
                absent[core].compute_overlap(rows["start_ns"], rows["end_ns"]) == 0
            )
            judged = undisturbed if undisturbed.any() else settled
            by_task[task.name] = Cycles(
                task=task,
                core=core,
                priority=priority,
                rows=rows,
                exchange_ns=exchange_ns,
                read_ns=read_ns,
                process_ns=process_ns,
                write_ns=write_ns,
                is_judged=judged,
                stalled_count=int(settled.sum() - judged.sum()),
            )
    return by_task


def _find_settled_cycles(recording: Recording, task: str, ticks: np.ndarray) -> np.ndarray:
    """Return a mask of the cycles that lie outside the start-up of a process.

    If every cycle lies within a start-up, the mask is True for all of them.
    """
    span = recording.layout.to_ticks(START_UP_S)
    settled = np.ones(len(ticks), bool)
    for start_tick in (0, *list_restarts(recording).get(task, ())):
        settled &= (ticks < start_tick) | (ticks >= start_tick + span)
    return settled if settled.any() else np.ones(len(ticks), bool)


def list_restarts(recording: Recording) -> dict[str, list[int]]:
    """Return a dictionary from task to the ticks at which it rejoined the rack after a restart."""
    rejoin_ticks: dict[str, list[int]] = {}
    for event in recording.events:
        if event.get("code") == "rejoined":
            rejoin_ticks.setdefault(event["board"], []).append(event["tick"])
    return rejoin_ticks


def measure_budgets(
    recording: Recording, percentile: float = WORST_PERCENTILE
) -> dict[str, Budget]:
    """Measure the processor time that each level of a run needs in a cycle.

    Each unit function is measured separately (eq. 3.6), so their longest times may come from
    different cycles. Cycles during a start-up (`START_UP_S`) are excluded. So are stalled cycles,
    because a virtual machine counts the time of a stall as processor time.

    Args:
        recording: The run.
        percentile: Percentage of the cycles that must fit into the budget.

    Returns:
        Dictionary from board to budget. Levels that never ran are left out.
    """
    return compute_budgets(read_cycles(recording), percentile)


def compute_budgets(cycles_by_task: Mapping[str, Cycles], percentile: float) -> dict[str, Budget]:
    """Compute the budget of each level from its measured cycles.

    Args:
        cycles_by_task: Cycles of each task, from `read_cycles`.
        percentile: Percentage of the cycles that must fit into the budget.

    Returns:
        Dictionary from board to budget.
    """
    return {
        cycles.task.board: _compute_budget(
            cycles, cycles_by_task.get(f"{name}.planner"), percentile
        )
        for name, cycles in cycles_by_task.items()
        if cycles.task.role == "executor"
    }


def _compute_budget(executor: Cycles, planner: Cycles | None, percentile: float) -> Budget:
    """Compute the budget of one level. `planner` is None for a level without a planner."""

    def worst_time(cycles: Cycles, times_ns: np.ndarray) -> int:
        """Return the percentile of a unit function's times, without excluded cycles."""
        return compute_percentile(times_ns[cycles.is_judged], percentile)

    planner_parts = {}
    if planner is not None:
        # P includes reading the inputs of the planner.
        planner_parts["plan_ns"] = worst_time(planner, planner.read_ns + planner.process_ns)
        planner_parts["update_ns"] = worst_time(planner, planner.write_ns)
    return Budget(
        read_ns=worst_time(executor, executor.read_ns),
        process_ns=worst_time(executor, executor.process_ns),
        write_ns=worst_time(executor, executor.write_ns),
        exchange_ns=worst_time(executor, executor.exchange_ns),
        **planner_parts,
    )


def compute_percentile(times_ns: np.ndarray, percentile: float) -> int:
    """Return a percentile of measured times, rounded up to the next measured time.

    Args:
        times_ns: The times, shape (n,).
        percentile: The percentile, 0 to 100.

    Returns:
        The time, or 0 if there are no times.
    """
    return int(np.percentile(times_ns, percentile, method="higher")) if len(times_ns) else 0
