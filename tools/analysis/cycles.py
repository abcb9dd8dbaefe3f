"""What the cycles of a run took of a processor, unit function by unit function.

The trace stamps the borders of the unit functions by the wall clock, and counts the processor time of a cycle as a
whole. Where a cycle was preempted, the two differ. What tasks of higher priority on the same core filled is taken
off the unit function in which they ran; what is still more than the processor time, since ordinary scheduling or
the machine interfered, is taken off those that are longer than they usually are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rack.backplane.layout import TaskSpec
from rack.backplane.trace import FIELDS, Flag
from rack.tools.analysis.occupation import Occupation
from rack.tools.console.answer import Failure
from rack.tools.recording import Recording

START_UP_S = 0.1
"""Simulated time from the beginning of a process in which its cycles are not judged.

It touches its memory for the first time and fills its caches: the first cycle of each level of the default rack takes
2 to 8 times what it usually takes, from the sixth on they are alike.
"""

_STAMPS = ("start_ns", "plan_ns", "read_ns", "process_ns", "end_ns")
_EXCHANGE, _READ, _PROCESS, _WRITE = range(4)


@dataclass(frozen=True)
class Cycles:
    """The cycles of one task, oldest first; a planner's are its plans.

    `rows` are the trace records, shape (n,). `parts` are processor times, ns, shape (n, 4): C, R, X, W of an executor;
    0, reading, P, U of a planner. `is_judged` leaves out what belongs to the start-up of a process, shape (n,).
    `core` and `priority` are those that the task had; `overhead_ns` is what a cycle takes beside its parts, waking
    up for it and closing it.
    """

    task: TaskSpec
    core: int
    priority: int
    rows: np.ndarray
    parts: np.ndarray
    is_judged: np.ndarray
    overhead_ns: int

    @property
    def exchange_ns(self) -> np.ndarray:
        """C, reading the plan, shape (n,)."""
        return self.parts[:, _EXCHANGE]

    @property
    def read_ns(self) -> np.ndarray:
        """R, reading commands and statuses, shape (n,)."""
        return self.parts[:, _READ]

    @property
    def process_ns(self) -> np.ndarray:
        """X of an executor, P of a planner, shape (n,)."""
        return self.parts[:, _PROCESS]

    @property
    def write_ns(self) -> np.ndarray:
        """W of an executor, U of a planner, shape (n,)."""
        return self.parts[:, _WRITE]

    @property
    def communication_ns(self) -> np.ndarray:
        """t_comm of an executor: C, R and W, shape (n,)."""
        return np.asarray(self.exchange_ns + self.read_ns + self.write_ns)

    @property
    def used_ns(self) -> np.ndarray:
        """All parts together, shape (n,)."""
        return np.asarray(self.parts.sum(axis=1))


def cycles_of(recording: Recording) -> dict[str, Cycles]:
    """Return the cycles of every task of a run that has left any, by task.

    Raises `Failure` for a recording that lacks columns of the trace.
    """
    lacking = [name for name in FIELDS if name not in recording.columns]
    if lacking:
        raise Failure(
            f"{recording.folder}: cycles.parquet has no column {', '.join(lacking)}: "
            "it was recorded before those times were traced; run the rack again",
            2,
        )
    tasks = [task for task in recording.layout.tasks if len(recording.cycles.get(task.name, ()))]
    places = {task.name: _obtained(recording, task) for task in tasks}
    spans = {task.name: occupation(recording.cycles[task.name]) for task in tasks}
    planned = {task.name for task in recording.layout.tasks if task.role == "planner"}
    found = {}
    for task in tasks:
        core, priority = places[task.name]
        above = [name for name, (on, at) in places.items() if on == core and at > priority]
        rows = recording.cycles[task.name]
        rows = rows[(rows["flags"] & Flag.PLANNED) > 0] if task.role == "planner" else rows
        if len(rows):
            parts = _parts(rows, Occupation.of_all([spans[name] for name in above]))
            if task.role == "executor" and f"{task.name}.planner" not in planned:
                # Finding out that there is no plan to read.
                parts[:, _READ] += parts[:, _EXCHANGE]
                parts[:, _EXCHANGE] = 0
            judged = _judged(recording, task.name, rows["tick"])
            found[task.name] = Cycles(task, core, priority, rows, parts, judged, _overhead_ns(rows))
    return found


def occupation(rows: np.ndarray) -> Occupation:
    """Return when a task had its core, or would have had it, by its records: waking up and closing counted."""
    half = _overhead_ns(rows) // 2
    return Occupation(rows["start_ns"] - half, rows["end_ns"] + half)


def _obtained(recording: Recording, task: TaskSpec) -> tuple[int, int]:
    """Return core and priority that a task had; what the config asks for where the run's end is not recorded."""
    counted: Mapping[str, Any] = recording.ended.get("tasks", {}).get(task.name, {})
    return counted.get("core", task.core), counted.get("priority", task.priority)


def _overhead_ns(rows: np.ndarray) -> int:
    """Return what an undisturbed cycle takes beside its parts, in the middle of all; 0 where none was undisturbed."""
    beside = rows["processor_ns"] - (rows["end_ns"] - rows["start_ns"])
    return int(np.median(beside[beside >= 0])) if (beside >= 0).any() else 0


def _parts(rows: np.ndarray, above: Occupation) -> np.ndarray:
    """Return the processor time of each part, shape (n, 4), given when tasks of higher priority had the core."""
    stamps = np.stack([rows[name] for name in _STAMPS], axis=1)
    starts, ends = stamps[:, :-1], stamps[:, 1:]
    parts = ends - starts - above.within(starts, ends)
    beyond = parts.sum(axis=1) - rows["processor_ns"]
    beyond = np.where(beyond > 0, beyond + _overhead_ns(rows), 0)
    unusual = np.clip(parts - np.median(parts, axis=0), 0, None)
    parts = parts - _shared(beyond, unusual)
    # What is left can be told from nothing: every part gives as its length is.
    rest = np.clip(parts.sum(axis=1) - rows["processor_ns"], 0, None)
    return np.asarray(np.rint(parts - _shared(rest, parts)), np.int64)


def _shared(total: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return `total`, shape (n,), shared out by `weights`, shape (n, 4), to none more than its weight."""
    sums = weights.sum(axis=1)
    factor = np.divide(np.minimum(total, sums), sums, out=np.zeros(len(sums)), where=sums > 0)
    return np.asarray(weights * factor[:, None])


def _judged(recording: Recording, task: str, ticks: np.ndarray) -> np.ndarray:
    """Return which cycles do not belong to the start-up of a process; all do where none would be left."""
    span = round(START_UP_S * 1e9 / recording.layout.clock_ns)
    judged = np.ones(len(ticks), bool)
    for begun in (0, *restarts(recording).get(task, ())):
        judged &= (ticks < begun) | (ticks >= begun + span)
    return judged if judged.any() else np.ones(len(ticks), bool)


def restarts(recording: Recording) -> dict[str, list[int]]:
    """Return by task the ticks at which new processes of it took their place."""
    found: dict[str, list[int]] = {}
    for event in recording.events:
        if event.get("code") == "rejoined":
            found.setdefault(event["board"], []).append(event["tick"])
    return found
