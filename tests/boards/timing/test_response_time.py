"""Worst-case response times against published examples, and against schedules drawn out unit by
unit."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import NamedTuple

import pytest

from rack.boards.timing.response_time import (
    Load,
    compute_blocking_ns,
    compute_loads,
    compute_response_time,
    compute_task_responses,
)
from rack.boards.timing.tasks import Part, TimedTask, Unit

SETS = 100
PERIODS = (4, 5, 6, 8, 10, 12, 15, 20, 24)
"""Their hyperperiod is short, 120."""


class Plain(NamedTuple):
    """A task in whole units of time; those of a set stand in the order of their priorities, highest
    first."""

    cost: int
    period: int


def seen(tasks: list[Plain], blocked: int = 0) -> list[int]:
    """Draw the schedule of queueing jobs, unit by unit, until nothing is left to do; return the
    longest responses.

    It is the worst case: all tasks are released at 0; a part that cannot be preempted has taken the
    core just before, until `blocked`.
    """
    queues: list[list[list[int]]] = [[] for _ in tasks]  # the jobs of each task: release, time left
    worst, now = [0] * len(tasks), 0
    while now == 0 or any(queues):
        for queue, (cost, period) in zip(queues, tasks, strict=True):
            if now % period == 0:
                queue.append([now, cost])
        first = next((at for at, queue in enumerate(queues) if queue), None)
        now += 1
        if now > blocked and first is not None:
            queues[first][0][1] -= 1
            if not queues[first][0][1]:
                worst[first] = max(worst[first], now - queues[first].pop(0)[0])
    return worst


def response(
    cost: int, above: Sequence[Load], blocking: int = 0, horizon: int = 10**5
) -> int | None:
    return compute_response_time(cost, above, blocking, sharing=(), horizon=horizon)


def response_times(tasks: Sequence[TimedTask], switch_ns: int = 0) -> dict[str, int | None]:
    return {found.task: found.response_ns for found in compute_task_responses(tasks, switch_ns)}


def analysed(tasks: list[Plain], blocked: int = 0) -> list[int | None]:
    return [response(t.cost, tasks[:at], blocked) for at, t in enumerate(tasks)]


def drawn(draw: random.Random, full: bool = False) -> list[Plain]:
    """Return a random set of tasks that one processor has time for, fully loaded only if that is
    wanted."""
    while True:
        tasks = [Plain(draw.randint(1, 6), draw.choice(PERIODS)) for _ in range(draw.randint(2, 5))]
        if sum(120 // t.period * t.cost for t in tasks) < 120 + full:
            return tasks


def timed(name: str, core: int, priority: int, every: int, *parts: Part, **more: int) -> TimedTask:
    return TimedTask(name, name.partition(".")[0], "executor", core, priority, every, parts, **more)


def computing(time: int) -> Part:
    return Part(Unit.PROCESS, time)


@pytest.mark.parametrize(
    ("tasks", "expected"),
    [
        # A. Burns and A. Wellings, Real-Time Systems and Programming Languages: process sets B and
        # C, rate monotonic.
        ([Plain(3, 7), Plain(3, 12), Plain(5, 20)], [3, 6, 20]),
        ([Plain(5, 20), Plain(10, 40), Plain(40, 80)], [5, 15, 80]),
        # J. Lehoczky, Fixed Priority Scheduling of Periodic Task Sets with Arbitrary Deadlines
        # (1990), table 1: the first job of the second task.
        ([Plain(26, 70), Plain(62, 100)], [26, 114]),
    ],
)
def test_published_examples_are_reproduced(tasks: list[Plain], expected: list[int]) -> None:
    assert analysed(tasks) == expected


@pytest.mark.parametrize(("full", "most_blocked"), [(True, 0), (False, 8)])
def test_response_times_agree_with_simulated_schedules(full: bool, most_blocked: int) -> None:
    draw = random.Random(12)
    for _ in range(SETS):
        tasks, blocked = drawn(draw, full), draw.randint(0, most_blocked)
        bounds = analysed(tasks, blocked)
        for task, bound, worst in zip(tasks, bounds, seen(tasks, blocked), strict=True):
            # With full load above, a job has no bound; such sets are not drawn.
            assert bound is not None, tasks
            # Otherwise it waits for the one before it.
            assert bound == worst or (bound < worst and worst > task.period), tasks


def test_overload_has_no_bound() -> None:
    full, overloaded = [(2, 4), (3, 6)], [(2, 4), (4, 6)]
    assert response(2, full) is response(2, overloaded) is None


def test_the_search_ends_at_its_horizon_or_after_too_many_steps() -> None:
    assert response(0, []) == 0
    # A billionth of the core is left: the end lies 10^10 jobs ahead, and before the horizon.
    assert response(500_000, [(9_999, 10_000), (99_999, 10**9)], horizon=10**15) is None
    above = [(5, 10), (49_999, 100_000)]
    assert response(7, above, horizon=100_000) is None
    found = response(7, above, horizon=10_000_000)
    assert found is not None
    assert found > 100_000


def test_every_job_includes_two_context_switches() -> None:
    tasks = [timed("high", 0, 20, 10, computing(2)), timed("low", 0, 10, 40, computing(9))]
    # 9 + 2 and two jobs of 2 + 2.
    assert response_times(tasks, 1) == {"high": 4, "low": 19}
    assert compute_loads(tasks, context_switch_ns=1) == {0: pytest.approx(4 / 10 + 11 / 40)}


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        pytest.param((0, 10, 10, 4), (1, 20, 10, 9), [4, 9], id="other cores do not interfere"),
        pytest.param((0, 10, 10, 3), (0, 10, 10, 4), [7, 7], id="equals delay each other"),
        pytest.param((0, 0, 20, 5), (0, 1, 10, 4), [9, 4], id="ordinary tasks wait for others"),
        pytest.param((0, 10, 10, 0), (0, 10, 10, 4), [None, 4], id="no cost, no response"),
    ],
)
def test_two_tasks_respond(
    one: tuple[int, ...], other: tuple[int, ...], expected: list[int | None]
) -> None:
    tasks = [
        timed(name, core, priority, every, computing(cost))
        for name, (core, priority, every, cost) in (("one", one), ("other", other))
    ]
    found = response_times(tasks)
    assert [found.get("one"), found.get("other")] == expected


def test_only_a_ceiling_at_its_priority_or_above_blocks_a_task() -> None:
    update = Part(Unit.UPDATE, 3, preemptible=False)
    planner = timed("level.planner", 0, 5, 40, Part(Unit.PLAN, 6), update, ceiling=20)
    tasks = [
        timed(name, 0, priority, 40, computing(1))
        for name, priority in (("above", 21), ("own", 20), ("low", 4))
    ]
    tasks.append(planner)
    blocked = {task.name: ns for task in tasks if (ns := compute_blocking_ns(task, tasks))}
    assert blocked == {"own": 3}
    assert response_times(tasks) == {"above": 1, "own": 1 + 1 + 3, "low": 12, "level.planner": 11}
