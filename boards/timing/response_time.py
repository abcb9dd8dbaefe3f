"""Worst-case response times of tasks that share a core under fixed priorities: exact analysis,
beyond the paper.

The recurrence is M. Joseph and P. Pandya's, *Finding Response Times in a Real-Time System*, The
Computer Journal 29 (1986); with blocking it is N. Audsley et al.'s, *Applying New Scheduling Theory
to Static Priority Pre-emptive Scheduling*, Software Engineering Journal 8 (1993):

    R = B + C + sum over all tasks above of ceil(R / T_j) C_j.

This is the response of a job released together with all tasks above it. A rack without phases
releases all tasks together at tick 0, so the bound is attained. Phases may keep tasks apart for
ever, as in a static cyclic schedule: then response times are those of the schedule itself, which
repeats. Times are integers in one unit; a rack uses ns.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from itertools import pairwise
from math import lcm
from typing import Any

from rack.boards.timing.schedule import simulate
from rack.boards.timing.tasks import Part, TimedTask, Unit

Load = tuple[int, int]
"""Demand of a task on its core: cost C of a job, and period T."""

TURN_NS = 4_000_000
"""Longest turn of an ordinary task while another waits: one tick of a 250 Hz kernel (Linux's own
slice is 3 ms)."""
HORIZON_DEADLINES = 10
"""The search for a response time ends after this many deadlines: near full load it converges too
slowly."""
MAX_JOBS = 20_000
"""Limit on the jobs of a schedule that is computed for its response times; beyond it the bound must
do."""
MAX_STEPS = 10_000
"""Limit on the steps of one search: a 10 us tick against a plan of hours takes too many before any
deadline."""


def response_time(
    cost: int,
    above: Sequence[Load],
    blocking: int,
    *,
    sharing: Sequence[Load],
    horizon: int,
) -> int | None:
    """Return the longest time from a job's release to its end; None: no bound, or none within the
    `horizon`.

    `above` are the tasks of higher or equal priority on the core: each delays the job by whole jobs
    of its own. `blocking` is the longest part of a lower task that cannot be preempted.

    Releases do not queue: a late task takes up the newest release and skips the others, so the job
    finds its task free, and a response longer than the task's period is a miss.

    `sharing` are tasks under ordinary scheduling that take turns with this one: while it waits,
    none of them computes more than it does, plus one turn. That bound assumes fair turns, which
    Linux does not guarantee.
    """
    # Below full load a bound exists; near full load the search for it may take too long.
    if cost and sum(Fraction(*load) for load in above) >= 1:
        return None

    def work(until: int) -> int:
        turns = sum(min(_released(until, load), cost + TURN_NS) for load in sharing)
        return blocking + cost + turns + sum(_released(until, load) for load in above)

    # The end is the smallest time at which all work released before it is done.
    end = blocking + cost
    for _ in range(MAX_STEPS):
        if end > horizon:
            break
        if (needed := work(end)) <= end:
            return end
        end = needed
    return None


def _released(until: int, load: Load) -> int:
    cost, period = load
    return -(-until // period) * cost


def _scheduled(tasks: Sequence[TimedTask], context_switch_ns: int) -> dict[str, int]:
    """Return the response times of the tasks of one core, from their schedule; empty where it
    decides nothing.

    In the worst case every job takes its whole budget: under fixed priorities shorter jobs delay no
    other. A planner may plan at any release, so its jobs have no fixed place. Tasks of equal
    priority must never wait at the same time, since their order is not fixed either.
    """
    period = lcm(*(task.period_ns for task in tasks))
    first = max(task.phase_ns for task in tasks)
    until = first + 2 * period
    is_open = any(task.role == "planner" for task in tasks)
    if is_open or sum(until // task.period_ns for task in tasks) > MAX_JOBS:
        return {}
    whole = [as_one_part(task, context_switch_ns) for task in tasks]
    chart = simulate(whole, until + max(task.period_ns for task in tasks))
    priorities = {task.name: task.priority for task in tasks}
    spent = defaultdict[int, list[tuple[int, int]]](list)
    found = dict.fromkeys(priorities, 0)
    for job in chart.jobs:
        if job.release_ns >= until:
            continue
        if job.end_ns is None or job.end_ns > job.deadline_ns:
            return {}
        found[job.task] = max(found[job.task], job.end_ns - job.release_ns)
        spent[priorities[job.task]].append((job.release_ns, job.end_ns))
    shared = any(
        later[0] < earlier[1]
        for jobs in spent.values()
        for earlier, later in pairwise(sorted(jobs))
    )
    return {} if shared else found


@dataclass(frozen=True)
class TaskResponse:
    """One task in the worst case, ns.

    `job_ns` is its own processor time with two context switches, `blocking_ns` the longest wait for
    a task of lower priority, `response_ns` the time from its release to its end, None without a
    bound.
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
        """Whether it always meets its deadline."""
        return self.response_ns is not None and self.response_ns <= self.deadline_ns

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return asdict(self) | {"holds": self.holds}


def task_responses(
    tasks: Iterable[TimedTask], context_switch_ns: int = 0
) -> tuple[TaskResponse, ...]:
    """Return the worst case of every task with a cost.

    A job takes two context switches, into it and out of it (eq. 3.9); its response includes both.
    Tasks of equal priority delay each other by whole jobs; tasks under ordinary scheduling
    (priority 0) take turns. The bound is exact for tasks of different priorities without blocking;
    it does not credit a job for its own parts that cannot be preempted. On a core with phases the
    schedule itself is exact, if it repeats.
    """
    busy = [task for task in tasks if task.cost_ns]
    exact: dict[str, int] = {}
    for core in {task.core for task in busy if task.phase_ns}:
        exact |= _scheduled([task for task in busy if task.core == core], context_switch_ns)
    found = []
    for task in busy:
        others = [other for other in busy if other.core == task.core and other is not task]
        shares = [other for other in others if not task.priority and not other.priority]
        above = [
            other for other in others if other.priority >= task.priority and other not in shares
        ]
        job = job_ns(task, context_switch_ns)
        blocking = blocking_ns(task, others)
        bound = response_time(
            job,
            [_load(other, context_switch_ns) for other in above],
            blocking,
            sharing=[_load(other, context_switch_ns) for other in shares],
            horizon=HORIZON_DEADLINES * task.period_ns,
        )
        found.append(
            TaskResponse(
                task=task.name,
                core=task.core,
                priority=task.priority,
                job_ns=job,
                blocking_ns=blocking,
                response_ns=exact.get(task.name, bound),
                deadline_ns=task.period_ns,
            )
        )
    return tuple(found)


def job_ns(task: TimedTask, context_switch_ns: int) -> int:
    """Return the processor time of one job with its two context switches."""
    return task.cost_ns + 2 * context_switch_ns


def as_one_part(task: TimedTask, context_switch_ns: int) -> TimedTask:
    """Return a task whose job with its switches is one stretch of work."""
    return replace(task, parts=(Part(Unit.PROCESS, job_ns(task, context_switch_ns)),))


def blocking_ns(task: TimedTask, tasks: Iterable[TimedTask]) -> int:
    """Return the longest wait for a task of lower priority on the core, ns: one part that cannot be
    preempted.

    That is a plan update that began before the release and whose ceiling is at least this task's
    priority (eq. 3.10).
    """
    below = (t for t in tasks if t.core == task.core and t.priority < task.priority <= t.ceiling)
    locked = (part.time_ns for t in below for part in t.parts if not part.preemptible)
    return max(locked, default=0)


def load_of(tasks: Iterable[TimedTask], context_switch_ns: int) -> dict[int, float]:
    """Return the load of each core, by core, context switches included; above 1 it is
    overloaded.
    """
    loads: dict[int, float] = {}
    for task in tasks:
        if task.cost_ns:
            loads[task.core] = (
                loads.get(task.core, 0.0) + job_ns(task, context_switch_ns) / task.period_ns
            )
    return dict(sorted(loads.items()))


def _load(task: TimedTask, context_switch_ns: int) -> Load:
    return job_ns(task, context_switch_ns), task.period_ns
