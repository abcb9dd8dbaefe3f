"""Worst-case response times of tasks that share a core by fixed priorities: exact analysis, beyond the paper.

The recurrence is M. Joseph and P. Pandya's, *Finding Response Times in a Real-Time System*, The Computer Journal 29
(1986); with blocking and release jitter it is N. Audsley et al.'s, *Applying New Scheduling Theory to Static Priority
Pre-emptive Scheduling*, Software Engineering Journal 8 (1993):

    R = w + J,  w = B + C + sum over all tasks above of ceil((w + J_j) / T_j) C_j.

It is the response of a job that is released together with all those above: tasks that a rack releases together at 0
do meet it. Times are integers in one unit, ns in a rack.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from math import lcm

from rack.levels.timing.tasks import TimedTask

Load = tuple[int, int, int]
"""What a task asks of its core: cost C of a job, period T, release jitter J."""

TURN_NS = 4_000_000
"""Longest turn of an ordinary task while another one waits: a tick of a kernel of 250 Hz, Linux's own slice is 3 ms."""
MISSED_OVER = 10
"""Deadlines behind which a response time is no longer searched for: near full load the search would creep on."""
MOST_STEPS = 10_000
"""Steps of one search: with a tick of 10 us below a plan of hours it would creep on before any deadline."""


def response_time(
    cost: int,
    above: Sequence[Load],
    blocking: int = 0,
    jitter: int = 0,
    *,
    period: int | None = None,
    sharing: Sequence[Load] = (),
    turn: int = TURN_NS,
    horizon: int | None = None,
) -> int | None:
    """Return the longest time from a job's release to its end; None: there is no bound, or none within the `horizon`.

    `above` are the tasks of higher or equal priority on the core, each delaying the job by whole jobs of its own;
    `blocking` is the longest stretch for which a task below keeps it out.

    Without its `period` it is the response of a job that finds its task free; one longer than the period is a miss in
    a rack, where who is late takes up the newest release and skips those before. Give the `period` where releases
    queue up instead: then it is the longest of all jobs of the busy time (Lehoczky 1990), whatever the deadline.

    `sharing` are tasks that take turns with this one, as ordinary scheduling has it: while it waits, none of them
    computes more than it does, but for one `turn`. That is a bound for fair turns; Linux promises none. The default
    `horizon` is 100 times the longest of all times given.
    """
    # Below full load there is a bound; near it, the search for it may creep on.
    own = Fraction(cost, period) if period else Fraction(0)
    demand = sum((Fraction(c, t) for c, t, _ in above), own)
    if cost and (demand > 1 or (demand == 1 and not period)):
        return None
    longest = max([cost, period or 0, blocking, jitter, *(t for _, t, _ in above), *(t for _, t, _ in sharing)])
    horizon = 100 * longest if horizon is None else horizon
    worst, job, end = 0, 0, 0
    while True:
        work = blocking + (job + 1) * cost
        most = (job + 1) * cost + turn
        found = _end_of_busy_time(work, max(end, work), above, sharing, most, horizon + job * (period or 0))
        if found is None:
            return None
        end, worst = found, max(worst, found + jitter - job * (period or 0))
        job += 1
        if period is None or end + jitter <= job * period:
            return worst
        # At full load the busy time may not end; what follows repeats itself.
        if job * period > lcm(period, *(t for _, t, _ in above)):
            return worst


def _end_of_busy_time(
    work: int, guess: int, above: Sequence[Load], sharing: Sequence[Load], most: int, horizon: int
) -> int | None:
    """Return the smallest w not below `guess` for which `work` and all that is released until w is done at w."""
    for _ in range(MOST_STEPS):
        if guess > horizon:
            break
        demand = work + sum(_released(guess, load) for load in above)
        demand += sum(min(_released(guess, load), most) for load in sharing)
        if demand <= guess:
            return guess
        guess = demand
    return None


def _released(until: int, load: Load) -> int:
    cost, period, jitter = load
    return -(-(until + jitter) // period) * cost


def response_times(tasks: Iterable[TimedTask], context_switch_ns: int = 0) -> dict[str, int | None]:
    """Return the worst-case response time of every task that computes at all, ns, by name; core by core.

    A job takes two context switches, into it and out of it (eq. 3.9): its response includes both, as nothing else
    computes before. None: no bound, or none within `MISSED_OVER` deadlines. Tasks of equal priority delay each other
    by whole jobs; those of ordinary scheduling (priority 0) share time by turns. A bound is attained by tasks of
    different priorities without blocking; a part of a job that others cannot preempt is not counted in its own favour.
    """
    busy = [task for task in tasks if task.cost_ns]
    found = {}
    for task in busy:
        others = [other for other in busy if other.core == task.core and other is not task]
        shares = [other for other in others if not task.priority and not other.priority]
        above = [other for other in others if other.priority >= task.priority and other not in shares]
        found[task.name] = response_time(
            job_ns(task, context_switch_ns),
            [_load(other, context_switch_ns) for other in above],
            blocking_ns(task, others),
            task.jitter_ns,
            sharing=[_load(other, context_switch_ns) for other in shares],
            horizon=MISSED_OVER * task.period_ns,
        )
    return found


def job_ns(task: TimedTask, context_switch_ns: int) -> int:
    """Return the processor time of one job with its two context switches."""
    return task.cost_ns + 2 * context_switch_ns


def blocking_ns(task: TimedTask, tasks: Iterable[TimedTask]) -> int:
    """Return how long a task of lower priority on the core may keep this one out, ns: one such part at most.

    That is a plan update whose ceiling is at least this task's priority (eq. 3.10); it had begun before the release.
    """
    below = (t for t in tasks if t.core == task.core and t.priority < task.priority <= t.ceiling)
    return max((other.locked_ns for other in below), default=0)


def load_of(tasks: Iterable[TimedTask], context_switch_ns: int = 0) -> dict[int, float]:
    """Return the part of its time that each core computes, context switches included, by core; above 1: overloaded."""
    loads: dict[int, float] = {}
    for task in tasks:
        if task.cost_ns:
            loads[task.core] = loads.get(task.core, 0.0) + job_ns(task, context_switch_ns) / task.period_ns
    return dict(sorted(loads.items()))


def _load(task: TimedTask, context_switch_ns: int) -> Load:
    return job_ns(task, context_switch_ns), task.period_ns, task.jitter_ns
