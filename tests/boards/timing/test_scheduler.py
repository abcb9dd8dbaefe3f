"""Schedulers of a simulated core: which job runs, and when each ends."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from itertools import permutations
from math import lcm
from typing import NamedTuple

import pytest

from rack.backplane.words import Scheduler
from rack.boards.timing.schedule import simulate_schedule
from rack.boards.timing.scheduler import CoreJob, SimulatedCore
from rack.boards.timing.tasks import Part, TimedTask, Unit

FIXED, EARLIEST, URGENCY = Scheduler


class Load(NamedTuple):
    name: str
    period: int
    cost: int
    priority: int
    is_critical: bool = False

    def release(self, now: int, scheduler: Scheduler) -> CoreJob:
        due = now + self.period
        order = scheduler, self.priority, self.is_critical
        return CoreJob(self.name, now, *order, now, due, self.cost)


def run(loads: Sequence[Load], scheduler: Scheduler, until: int) -> dict[tuple[str, int], int]:
    """Run tasks on a core, and return the end of each job by task and release."""
    core = SimulatedCore()
    ends = {}
    for now in range(until):
        core.jobs += [load.release(now, scheduler) for load in loads if now % load.period == 0]
        while (job := core.run_until(now + 1)) is not None:
            ends[job.task, job.release] = core.now_ns
    return ends


def draw(rng: random.Random, left: float) -> Iterator[Load]:
    """Draw tasks that use at most a share `left` of a core, the fastest with the top priority."""
    for number, period in enumerate(sorted(rng.sample((4, 5, 6, 8, 10, 12, 15, 20), 4))):
        cost = rng.randint(1, max(1, int(left * period)))
        if cost <= left * period + 1e-9:
            left -= cost / period
            yield Load(f"t{number}", period, cost, 9 - number, rng.random() < 0.5)


@pytest.mark.parametrize("seed", range(20))
def test_fixed_priorities_give_the_schedule_of_the_gantt_chart(seed: int) -> None:
    # Up to this share rate-monotonic priorities meet all deadlines (Liu and Layland).
    loads = list(draw(random.Random(seed), 0.69))
    until = lcm(*(load.period for load in loads))
    tasks = []
    for name, period, cost, priority, _ in loads:
        parts = (Part(Unit.PROCESS, cost),)
        tasks.append(TimedTask(name, name, "executor", 0, priority, period, parts))
    chart = simulate_schedule(tasks, until)
    expected = {(job.task, job.release_ns): job.end_ns for job in chart.jobs}
    assert run(loads, FIXED, until) == expected


@pytest.mark.parametrize("seed", range(20))
def test_deadlines_are_met_up_to_the_whole_core_by_earliest_deadline_first(seed: int) -> None:
    loads = list(draw(random.Random(seed), 1.0))
    until = lcm(*(load.period for load in loads))
    ends = run(loads, EARLIEST, until)
    period = {load.name: load.period for load in loads}
    assert len(ends) == sum(until // load.period for load in loads)
    assert all(end <= release + period[task] for (task, release), end in ends.items())


OVERLOAD = (Load("fast", 4, 2, 9), Load("medium", 6, 3, 8), Load("slow", 12, 2, 7, True))
"""Tasks that need 1.17 of the core. Only the slowest is critical."""


def miss(scheduler: Scheduler) -> set[str]:
    """Return the tasks of `OVERLOAD` that have a late or unfinished job."""
    until = 600
    ends = run(OVERLOAD, scheduler, until)
    return {
        load.name
        for load in OVERLOAD
        for release in range(0, until - load.period, load.period)
        if ends.get((load.name, release), until) > release + load.period
    }


def test_an_overload_shows_what_each_scheduler_is_for() -> None:
    assert miss(FIXED) == {"medium", "slow"}
    assert miss(EARLIEST) == {"fast", "medium", "slow"}
    assert miss(URGENCY) == {"fast", "medium"}


def test_the_least_laxity_counts_among_equally_critical_jobs() -> None:
    # Laxities 3, 2 and 5; the earliest deadline and the highest priority would choose otherwise.
    jobs = [Load("a", 4, 1, 1), Load("b", 6, 4, 2), Load("c", 8, 3, 3)]
    core = SimulatedCore()
    core.jobs = [job.release(0, URGENCY) for job in jobs]
    ended = core.run_until(20)
    assert ended is not None
    assert ended.task == "b"


@pytest.mark.parametrize("order", list(permutations(Scheduler)))
def test_on_one_core_urgency_precedes_deadlines_and_these_precede_priorities(
    order: tuple[Scheduler, ...],
) -> None:
    core = SimulatedCore()
    # Whatever the deadlines and priorities are.
    core.jobs = [
        CoreJob(scheduler.word, 0, scheduler, 10 * at, False, 0, 100 - at, 5)
        for at, scheduler in enumerate(order)
    ]
    ended = [core.run_until(100) for _ in order]
    words = [job.task for job in ended if job is not None]
    assert words == [URGENCY.word, EARLIEST.word, FIXED.word]
    assert core.run_until(100) is None
    assert core.now_ns == 100


def test_a_change_of_the_scheduler_acts_on_a_job_that_has_begun() -> None:
    core = SimulatedCore()
    core.jobs = [
        CoreJob("first", 0, FIXED, 9, False, 0, 50, 20),
        CoreJob("second", 0, FIXED, 1, False, 0, 40, 20),
    ]
    assert core.run_until(10) is None
    core.jobs[1].scheduler = URGENCY
    ended = core.run_until(60), core.run_until(60)
    assert [job.task for job in ended if job] == ["second", "first"]
