"""One core, one unit of time after the other: what `rack.levels.timing.schedule` works out from event to event.

Written for tests, from the rules alone: slow, and too simple to be wrong in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence

from rack.levels.timing.tasks import TimedTask


def run(tasks: Sequence[TimedTask], until: int) -> tuple[list[str], dict[tuple[str, int], int]]:
    """Return who computes in each unit of time, "X of a", and the end of every job by task and release."""
    todo: dict[str, list[tuple[str, bool, bool]]] = {task.name: [] for task in tasks}
    release = {task.name: -1 for task in tasks}
    free_from = {task.name: 0 for task in tasks}
    late_by = {task.name: 0 for task in tasks}
    row, ends = [], {}
    for now in range(until):
        able = [task for task in tasks if todo[task.name] or free_from[task.name] <= now]
        if not able:
            row.append("-")
            continue
        task = min(able, key=lambda task: place(task, todo[task.name], free_from[task.name]))
        name = task.name
        if not todo[name]:
            newest = now - now % task.every_ns
            release[name] = max(free_from[name], newest - late_by[name])
            late_by[name] = (task.within_cycles - 1) * task.every_ns
            for part in task.parts:
                units = [(part.unit.value, not part.preemptible, at > 0) for at in range(part.time_ns)]
                todo[name] += units
        letter, _, _ = todo[name].pop(0)
        row.append(f"{letter} of {name}")
        if not todo[name]:
            ends[name, release[name]] = now + 1
            free_from[name] = release[name] + task.period_ns
    return row, ends


def place(task: TimedTask, todo: list[tuple[str, bool, bool]], since: int) -> tuple[int, int, int, str]:
    """Return the order in which tasks get the core; the lowest does."""
    is_locked = bool(todo) and todo[0][1] and todo[0][2]
    priority = max(task.priority, task.ceiling) if is_locked else task.priority
    return -priority, 0 if is_locked else 1, since, task.name
