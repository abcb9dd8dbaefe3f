"""Schedulers of a simulated core: which job runs, and when each ends."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Sequence
from itertools import permutations
from math import lcm
from typing import NamedTuple

import pytest

from rack.backplane.words import Scheduler
from rack.boards.timing.response_time import compute_task_responses
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
    due: int = 0
    scheduler: Scheduler = FIXED

    @property
    def deadline(self) -> int:
        return self.due or self.period

    def release(self, now: int) -> CoreJob:
        due = now + self.period
        order = self.scheduler, self.priority, self.is_critical
        return CoreJob(self.name, *order, now, due, self.cost)


def replace_scheduler(loads: Iterable[Load], scheduler: Scheduler) -> list[Load]:
    return [load._replace(scheduler=scheduler) for load in loads]


def run(loads: Sequence[Load], until: int) -> dict[tuple[str, int], int]:
    """Run tasks on a core, and return the end of each job by task and release."""
    core = SimulatedCore()
    ends = {}
    for now in range(until):
        core.jobs += [load.release(now) for load in loads if now % load.period == 0]
        while (job := core.run_until(now + 1)) is not None:
            ends[job.task, job.ready_at] = core.now_ns
    return ends


def draw(rng: random.Random, left: float) -> Iterator[Load]:
    """Draw tasks that use at most a share `left` of a core, the fastest with the top priority."""
    for number, period in enumerate(sorted(rng.sample((4, 5, 6, 8, 10, 12, 15, 20), 4))):
        cost = rng.randint(1, max(1, int(left * period)))
        if cost <= left * period + 1e-9:
            left -= cost / period
            yield Load(f"t{number}", period, cost, 9 - number, rng.random() < 0.5)


def build_tasks(loads: Sequence[Load]) -> list[TimedTask]:
    return [
        TimedTask(
            name=load.name,
            board=load.name,
            role="executor",
            core=0,
            priority=load.priority,
            every_ns=load.period,
            parts=(Part(Unit.PROCESS, load.cost),),
            due_ns=load.due,
            scheduler=load.scheduler,
            is_critical=load.is_critical,
        )
        for load in loads
    ]


@pytest.mark.parametrize("seed", range(20))
def test_fixed_priorities_give_the_schedule_of_the_gantt_chart(seed: int) -> None:
    # Up to this share rate-monotonic priorities meet all deadlines (Liu and Layland).
    loads = list(draw(random.Random(seed), 0.69))
    until = lcm(*(load.period for load in loads))
    chart = simulate_schedule(build_tasks(loads), until)
    expected = {(job.task, job.release_ns): job.end_ns for job in chart.jobs}
    assert run(loads, until) == expected


@pytest.mark.parametrize("seed", range(20))
def test_deadlines_are_met_up_to_the_whole_core_by_earliest_deadline_first(seed: int) -> None:
    loads = replace_scheduler(draw(random.Random(seed), 1.0), EARLIEST)
    until = lcm(*(load.period for load in loads))
    ends = run(loads, until)
    period = {load.name: load.period for load in loads}
    assert len(ends) == sum(until // load.period for load in loads)
    assert all(end <= release + period[task] for (task, release), end in ends.items())


OVERLOAD = (Load("fast", 4, 2, 9), Load("medium", 6, 3, 8), Load("slow", 12, 2, 7, True))
"""Tasks that need 1.17 of the core. Only the slowest is critical."""


def test_an_overload_shows_what_each_scheduler_is_for() -> None:
    for scheduler, late in (
        (FIXED, {"medium", "slow"}),
        (EARLIEST, {"fast", "medium", "slow"}),
        (URGENCY, {"fast", "medium"}),
    ):
        assert find_late(replace_scheduler(OVERLOAD, scheduler)) == late


def test_the_least_laxity_counts_among_equally_critical_jobs() -> None:
    # Laxities 3, 2 and 5; the earliest deadline and the highest priority would choose otherwise.
    loads = [Load("a", 4, 1, 1), Load("b", 6, 4, 2), Load("c", 8, 3, 3)]
    core = SimulatedCore()
    core.jobs = [load.release(0) for load in replace_scheduler(loads, URGENCY)]
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
        CoreJob(scheduler.word, scheduler, 10 * at, False, 0, 100 - at, 5)
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
        CoreJob("first", FIXED, 9, False, 0, 50, 20),
        CoreJob("second", FIXED, 1, False, 0, 40, 20),
    ]
    assert core.run_until(10) is None
    core.jobs[1].scheduler = URGENCY
    ended = core.run_until(60), core.run_until(60)
    assert [job.task for job in ended if job] == ["second", "first"]


def draw_scheduled(rng: random.Random, *schedulers: Scheduler) -> list[Load]:
    """Draw tasks that use about the whole core, some with deadlines before their periods."""
    loads = []
    for number, period in enumerate(rng.sample((4, 5, 6, 8, 10, 12, 15, 20), rng.randint(2, 4))):
        cost = rng.randint(1, max(1, period // 2))
        due = rng.choice((0, rng.randint(cost, period)))
        is_critical = rng.random() < 0.5
        scheduler = rng.choice(schedulers)
        loads.append(Load(f"t{number}", period, cost, 9 - number, is_critical, due, scheduler))
    return loads


def find_late(loads: Sequence[Load]) -> set[str]:
    """Return the tasks that miss a deadline on a core on which all are released together."""
    until = 2 * lcm(*(load.period for load in loads))
    ends = run(loads, until)
    return {
        load.name
        for load in loads
        for release in range(0, until - load.period, load.period)
        if ends.get((load.name, release), until) > release + load.deadline
    }


def find_failing(loads: Sequence[Load]) -> set[str]:
    """Return the tasks that may be late, as `rack check` says."""
    return {
        each.task for each in compute_task_responses(build_tasks(loads), 0, 1) if not each.holds
    }


def meets_demand(loads: Sequence[Load]) -> bool:
    """Apply the processor demand criterion: jobs whose periods end by a time need no more."""
    return all(
        sum(end // load.period * load.cost for load in loads) <= end
        for end in range(1, 2 * lcm(*(load.period for load in loads)))
    )


@pytest.mark.thorough
def test_the_verdict_on_earliest_deadline_first_is_that_of_demand_and_schedule() -> None:
    rng = random.Random(49)
    fits = []
    for _ in range(300):
        loads = draw_scheduled(rng, EARLIEST)
        found = find_failing(loads)
        assert bool(found) == bool(find_late(loads)), loads
        whole = [load._replace(due=0) for load in loads]
        assert bool(find_failing(whole)) == bool(find_late(whole)) == (not meets_demand(loads))
        fits.append(not found)
    assert 30 < sum(fits) < 270


@pytest.mark.parametrize("schedulers", [(URGENCY,), tuple(Scheduler)], ids=["urgency", "all"])
def test_tasks_that_fit_under_their_schedulers_are_never_late(
    schedulers: tuple[Scheduler, ...],
) -> None:
    rng = random.Random(50)
    fits = []
    for _ in range(300):
        loads = draw_scheduled(rng, *schedulers)
        late = find_late(loads)
        failing = find_failing(loads)
        assert late <= failing, loads
        assert bool(late) == bool(failing), loads
        fits.append(not late)
    assert 30 < sum(fits) < 270


def test_critical_tasks_fit_whatever_the_others_need() -> None:
    assert find_failing(replace_scheduler(OVERLOAD, URGENCY)) == {"fast", "medium"}


@pytest.mark.parametrize("scheduler", Scheduler)
def test_a_chart_shows_the_schedule_of_the_scheduler(scheduler: Scheduler) -> None:
    rng = random.Random(51)
    drawn = [draw_scheduled(rng, scheduler) for _ in range(60)]
    fitting = [loads for loads in drawn if not find_late(loads)]
    assert len(fitting) > 5
    for loads in fitting:
        until = lcm(*(load.period for load in loads))
        chart = simulate_schedule(build_tasks(loads), until, tick_ns=1)
        ends = {(job.task, job.release_ns): job.end_ns for job in chart.jobs}
        assert ends == run(loads, until), loads
