"""The worst case of each task on its core, with what makes it so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rack.levels.timing.response_time import blocking_ns, job_ns, response_times
from rack.levels.timing.tasks import TimedTask


@dataclass(frozen=True)
class TaskResponse:
    """One task in the worst case, ns.

    `job_ns` is its own processor time with two context switches, `blocking_ns` how long a task of lower priority may
    keep it out, `response_ns` the time from its release to its end; None: there is no bound.
    """

    task: str
    core: int
    priority: int
    job_ns: int
    blocking_ns: int
    response_ns: int | None
    deadline_ns: int

    @property
    def holds(self) -> bool:
        """Whether it always ends by its deadline."""
        return self.response_ns is not None and self.response_ns <= self.deadline_ns

    def document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self) | {"holds": self.holds}


def task_responses(tasks: Sequence[TimedTask], context_switch_ns: int) -> tuple[TaskResponse, ...]:
    """Return the worst case of every task that computes at all."""
    found = response_times(tasks, context_switch_ns)
    return tuple(
        TaskResponse(
            task=task.name,
            core=task.core,
            priority=task.priority,
            job_ns=job_ns(task, context_switch_ns),
            blocking_ns=blocking_ns(task, tasks),
            response_ns=found[task.name],
            deadline_ns=task.period_ns,
        )
        for task in tasks
        if task.name in found
    )
