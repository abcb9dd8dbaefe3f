"""The cycles of a run, unit function by unit function, and the budgets that they amount to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.boards.timing.tasks import Budget
from rack.boards.timing.trace_times import Occupation, overhead_ns, plans, unit_times
from rack.tools.recording.recording import Recording
from rack.tools.recording.stalls import stalls_of

START_UP_S = 0.1
"""Simulated time after the start of a process in which its cycles are not judged.

It touches its memory for the first time and fills its caches: the first cycle of each level of the
default rack takes 2 to 8 times as long as usual; from the sixth on they are alike.
"""
WORST = 100.0
"""The percentile of eq. 3.6: the longest of all cycles."""


@dataclass(frozen=True)
class Cycles:
    """The cycles of one task, oldest first; of a planner only those that made a plan.

    `rows` are the trace records, shape (n,). Processor times, ns, shape (n,): `exchange_ns`, C,
    reading the plan, 0 of a planner; `read_ns`, R, reading commands and statuses; `process_ns`, X
    or P; `write_ns`, W or U. `is_judged` excludes the start-up of a process, and the `stalled`
    cycles: those in which the core may have been away (see `stalls_of`); bool, shape (n,). `core`
    and `priority` are those that the task obtained; `overhead_ns` is the processor time of a cycle
    outside its parts, for waking up and closing it. `stretches` are those of the recording, shape
    (n,), see `Recording.stretch_of`.
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
    stalled: int
    overhead_ns: int
    stretches: np.ndarray

    @property
    def communication_ns(self) -> np.ndarray:
        """t_comm of an executor: C, R and W, shape (n,)."""
        return np.asarray(self.exchange_ns + self.read_ns + self.write_ns)

    @property
    def used_ns(self) -> np.ndarray:
        """All parts together, shape (n,)."""
        return np.asarray(self.communication_ns + self.process_ns)


def cycles_of(recording: Recording) -> dict[str, Cycles]:
    """Return the cycles of a run by task; tasks without any are left out."""
    tasks = [task for task in recording.layout.tasks if len(recording.cycles.get(task.name, ()))]
    places = {task.name: recording.place(task) for task in tasks}
    _, away = stalls_of(recording)
    spans = {task.name: Occupation.of(recording.cycles[task.name]) for task in tasks}
    planned = {task.name for task in recording.layout.tasks if task.role == "planner"}
    found = {}
    for task in tasks:
        core, priority = places[task.name]
        above = [name for name, (on, at) in places.items() if on == core and at > priority]
        rows = recording.cycles[task.name]
        rows = plans(rows) if task.role == "planner" else rows
        if len(rows):
            above_it = Occupation.union([spans[name] for name in above])
            exchange_ns, read_ns, process_ns, write_ns = unit_times(rows, above_it).T
            if task.role == "executor" and f"{task.name}.planner" not in planned:
                # Without a planner the look for a plan is part of reading.
                read_ns = read_ns + exchange_ns
                exchange_ns = np.zeros_like(read_ns)
            settled = _settled(recording, task.name, rows["tick"])
            whole = settled & (away[core].within(rows["start_ns"], rows["end_ns"]) == 0)
            judged = whole if whole.any() else settled
            found[task.name] = Cycles(
                task=task,
                core=core,
                priority=priority,
                rows=rows,
                exchange_ns=exchange_ns,
                read_ns=read_ns,
                process_ns=process_ns,
                write_ns=write_ns,
                is_judged=judged,
                stalled=int(settled.sum() - judged.sum()),
                overhead_ns=overhead_ns(rows),
                stretches=recording.stretch_of(rows["tick"]),
            )
    return found


def _settled(recording: Recording, task: str, ticks: np.ndarray) -> np.ndarray:
    """Return which cycles do not belong to the start-up of a process; all where none would be
    left.
    """
    span = round(START_UP_S * 1e9 / recording.layout.clock_ns)
    settled = np.ones(len(ticks), bool)
    for begun in (0, *restarts(recording).get(task, ())):
        settled &= (ticks < begun) | (ticks >= begun + span)
    return settled if settled.any() else np.ones(len(ticks), bool)


def restarts(recording: Recording) -> dict[str, list[int]]:
    """Return by task the ticks at which a new process of it rejoined."""
    found: dict[str, list[int]] = {}
    for event in recording.events:
        if event.get("code") == "rejoined":
            found.setdefault(event["board"], []).append(event["tick"])
    return found


def measured_budgets(recording: Recording, percentile: float = WORST) -> dict[str, Budget]:
    """Return the processor time that each level of a run took, by board; levels that never ran are
    left out.

    Each part is the longest of all cycles (eq. 3.6), whether or not they fell into the same one;
    with a `percentile` below 100, the longest of that many in a hundred. The start-up of processes
    (`START_UP_S`) is excluded, and so are cycles with a stall in them: a virtual machine stalled by
    its host counts that as processor time.
    """
    return budgets_of(cycles_of(recording), percentile)


def budgets_of(found: Mapping[str, Cycles], percentile: float) -> dict[str, Budget]:
    """Return the budgets, by board, of cycles from `cycles_of`."""
    executors = {name: cycles for name, cycles in found.items() if cycles.task.role == "executor"}
    return {
        cycles.task.board: _budget(cycles, found.get(f"{name}.planner"), percentile)
        for name, cycles in executors.items()
    }


def _budget(executor: Cycles, planner: Cycles | None, percentile: float) -> Budget:
    def worst(cycles: Cycles, times_ns: np.ndarray) -> int:
        return worst_of(times_ns[cycles.is_judged], percentile)

    of_plan = {}
    if planner is not None:
        # P includes reading the planner's inputs.
        of_plan["plan_ns"] = worst(planner, planner.read_ns + planner.process_ns)
        of_plan["update_ns"] = worst(planner, planner.write_ns)
    return Budget(
        read_ns=worst(executor, executor.read_ns),
        process_ns=worst(executor, executor.process_ns),
        write_ns=worst(executor, executor.write_ns),
        exchange_ns=worst(executor, executor.exchange_ns),
        **of_plan,
    )


def worst_of(times_ns: np.ndarray, percentile: float = WORST) -> int:
    """Return a percentile of times, shape (n,), as a time that was measured; 0 of none."""
    return int(np.percentile(times_ns, percentile, method="higher")) if len(times_ns) else 0
