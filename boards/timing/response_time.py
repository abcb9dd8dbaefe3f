"""Worst-case response times of tasks that share a core under fixed priorities.

This analysis is not in the paper. The recurrence is from M. Joseph and P. Pandya, *Finding Response
Times in a Real-Time System*, The Computer Journal 29 (1986); with blocking it is from N. Audsley et
al., *Applying New Scheduling Theory to Static Priority Pre-emptive Scheduling*, Software
Engineering Journal 8 (1993):

    R = B + C + sum over all tasks above of ceil(R / T_j) C_j.

R is the response of a job that is released together with all tasks of higher priority. A rack
without phases releases all tasks together at tick 0, so this bound is reached. Phases can keep
releases apart for ever, as in a static cyclic schedule. Response times are then taken from the
schedule itself, which repeats. Times are integers in one unit, which is ns for a rack.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from math import lcm
from typing import Any

from rack.backplane.words import Scheduler
from rack.boards.timing.schedule import simulate_schedule
from rack.boards.timing.tasks import TURN_NS, Part, TimedTask, Unit

FIXED = Scheduler.FIXED_PRIORITY
Load = tuple[int, int]
"""Demand of a task on its core: cost C of a job and period T, in the same unit."""

MAX_DEADLINES = 10
"""Number of deadlines after which the search ends, because it converges slowly near full load."""
MAX_JOBS = 20_000
"""Largest number of jobs in a schedule that is simulated. Longer schedules use the bound."""
MAX_STEPS = 10_000
"""Maximum number of steps of a search. A plan of hours with a tick of 10 us would need more."""


def compute_response_time(
    cost: int,
    above: Sequence[Load],
    blocking: int,
    *,
    sharing: Sequence[Load],
    horizon: int,
) -> int | None:
    """Compute the longest time in ns from the release of a job to its end.

    Releases do not queue: a late task takes the newest release and skips the others. A job
    therefore never waits for an earlier job of its task, and a response longer than the period is a
    deadline miss.

    Args:
        cost: Processor time of the job.
        above: Tasks of higher or equal priority on the core, whose jobs precede this one.
        blocking: Longest time for which a task of lower priority cannot be preempted.
        sharing: Tasks under ordinary scheduling that take turns with this one. Each of them is
            assumed to delay the job by at most the job's own cost and one turn. Linux does not
            guarantee such fair turns.
        horizon: Time after which the search ends.

    Returns:
        The time. None if there is no bound, or if it exceeds the horizon.
    """
    # At full load there is no bound. Just below it, the search for the bound may take too long.
    if cost and sum(Fraction(*load) for load in above) >= 1:
        return None

    def work(until: int) -> int:
        """Return the processor time that is needed before the job can end at `until`."""
        turns = sum(min(_sum_released_work(until, load), cost + TURN_NS) for load in sharing)
        return blocking + cost + turns + sum(_sum_released_work(until, load) for load in above)

    # The job ends at the earliest time at which all work released before that time is done.
    end = blocking + cost
    for _ in range(MAX_STEPS):
        if end > horizon:
            break
        if (needed := work(end)) <= end:
            return end
        end = needed
    return None


def _sum_released_work(until: int, load: Load) -> int:
    """Return the processor time of all jobs of a task that are released before `until`."""
    cost, period = load
    return -(-until // period) * cost


def _compute_scheduled_responses(
    tasks: Sequence[TimedTask], context_switch_ns: int, tick_ns: int | None
) -> dict[str, int]:
    """Return the exact response times of the tasks of one core, taken from their schedule.

    In the worst case every job uses its whole budget: by fixed priority or earliest deadline, a
    shorter job never delays another. Under maximum urgency first, which exists in lockstep only,
    every job does. By the processor demand criterion (Baruah, Rosier and Howell 1990), the earliest
    deadline meets all deadlines if it does so from a common release on.

    Args:
        tasks: The tasks.
        context_switch_ns: Time of one context switch.
        tick_ns: Length of a tick. None if it does not matter.

    Returns:
        The times in ns, keyed by task. Empty if a job outlasts its period, which may delay any
        other, or under fixed priorities if the schedule is too long or not exact. It is not exact
        if there are planners, which may plan at any release, or tasks of equal priority, whose
        order is not fixed.
    """
    periods = {task.name: task.period_ns for task in tasks}
    until = max(task.phase_ns for task in tasks) + 2 * lcm(*periods.values())
    limit = MAX_JOBS // len(tasks) * min(periods.values())
    fixed = [task for task in tasks if task.scheduler is FIXED]
    has_planner = any(task.role == "planner" for task in fixed)
    if fixed and (has_planner or until > limit or len({t.priority for t in fixed}) < len(fixed)):
        return {}
    until = min(until, limit)
    merged = [merge_parts(task, context_switch_ns) for task in tasks]
    chart = simulate_schedule(merged, until + max(periods.values()), tick_ns=tick_ns)
    responses = dict.fromkeys(periods, 0)
    for job in chart.jobs:
        if job.release_ns >= until:
            continue
        if job.end_ns is None or job.end_ns > job.release_ns + periods[job.task]:
            return {}
        responses[job.task] = max(responses[job.task], job.end_ns - job.release_ns)
    return responses


@dataclass(frozen=True)
class TaskResponse:
    """Worst-case response of one task.

    Attributes:
        task: Name of the task.
        core: Its core.
        priority: Its SCHED_FIFO priority.
        job_ns: Processor time of a job with two context switches.
        blocking_ns: Longest wait for a task of lower priority.
        response_ns: Longest time from the release of a job to its end. None without a bound.
        deadline_ns: Time from the release to the deadline.
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
        """Whether the task always meets its deadline."""
        return self.response_ns is not None and self.response_ns <= self.deadline_ns

    def to_document(self) -> dict[str, Any]:
        """Return the response as plain data, for JSON."""
        return asdict(self) | {"holds": self.holds}


def compute_task_responses(
    tasks: Iterable[TimedTask], context_switch_ns: int = 0, tick_ns: int | None = None
) -> tuple[TaskResponse, ...]:
    """Compute the worst-case response of every task that has a cost.

    A job has two context switches, to it and from it (eq. 3.9), and its response includes both.
    Tasks of equal priority delay each other by whole jobs. Tasks under ordinary scheduling
    (priority 0) take turns. Tasks that are scheduled by deadline or urgency precede all these.

    The bound is exact for tasks of different priorities without blocking. It ignores that a job's
    own parts may not be preemptible. The times come from the simulated schedule for tasks that are
    scheduled by deadline or urgency, and if it is exact, on a core whose tasks have phases.

    Args:
        tasks: The tasks.
        context_switch_ns: Time of one context switch.
        tick_ns: Length of a tick. None if it does not matter.
    """
    busy = [task for task in tasks if task.cost_ns]
    exact: dict[str, int] = {}
    by_schedule = [task for task in busy if task.phase_ns or task.scheduler is not FIXED]
    for core, rank in {(task.core, task.rank) for task in by_schedule}:
        # Tasks that are preceded by these do not matter.
        exact |= _compute_scheduled_responses(
            [t for t in busy if t.core == core and t.rank <= rank], context_switch_ns, tick_ns
        )
    demands = {t.name: (compute_job_ns(t, context_switch_ns), t.period_ns) for t in busy}
    responses = []
    for task in busy:
        others = [other for other in busy if other.core == task.core and other is not task]
        job, _ = demands[task.name]
        blocking = compute_blocking_ns(task, others)
        bound = compute_response_time(
            job,
            [
                demands[o.name]
                for o in others
                if (o.rank, -o.priority) <= (task.rank, -max(task.priority, 1))
            ],
            blocking,
            sharing=[
                demands[o.name]
                for o in others
                if (task.priority, o.priority, o.rank) == (0, 0, task.rank)
            ],
            horizon=MAX_DEADLINES * task.period_ns,
        )
        responses.append(
            TaskResponse(
                task=task.name,
                core=task.core,
                priority=task.priority,
                job_ns=job,
                blocking_ns=blocking,
                response_ns=exact.get(task.name, bound if task.scheduler is FIXED else None),
                deadline_ns=task.deadline_ns,
            )
        )
    return tuple(responses)


def compute_job_ns(task: TimedTask, context_switch_ns: int) -> int:
    """Return the processor time in ns of one job with its two context switches."""
    return task.cost_ns + 2 * context_switch_ns


def merge_parts(task: TimedTask, context_switch_ns: int) -> TimedTask:
    """Return a copy of a task whose job is a single part that includes the context switches."""
    return replace(task, parts=(Part(Unit.PROCESS, compute_job_ns(task, context_switch_ns)),))


def compute_blocking_ns(task: TimedTask, tasks: Iterable[TimedTask]) -> int:
    """Return the longest time in ns for which a task waits for tasks of lower priority.

    It is the time of one plan update that began before the task's release and whose ceiling is at
    least the task's priority (eq. 3.10).
    """
    below = (t for t in tasks if t.core == task.core and t.priority < task.priority <= t.ceiling)
    locked = (part.time_ns for t in below for part in t.parts if not part.preemptible)
    return max(locked, default=0)


def compute_loads(tasks: Iterable[TimedTask], context_switch_ns: int) -> dict[int, float]:
    """Return the load of each core, including context switches. Above 1 a core is overloaded."""
    loads = defaultdict[int, float](float)
    for task in tasks:
        if task.cost_ns:
            loads[task.core] += compute_job_ns(task, context_switch_ns) / task.period_ns
    return dict(sorted(loads.items()))
