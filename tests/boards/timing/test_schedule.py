"""Schedules: the paper's figures to the millisecond, and the rack's rules for late tasks."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

import pytest

from rack.boards.timing.schedule import Chart, simulate_schedule
from rack.boards.timing.tasks import Part, TimedTask, Unit

C, R, X, W, P, U = Unit


def parts(text: str, locked: str = "") -> tuple[Part, ...]:
    """Return parts of so many units of time each, as in "R1 X2 W1"; those of `locked` are not
    preemptible."""
    return tuple(Part(Unit(p[0]), int(p[1:]), p[0] not in locked) for p in text.split())


def executor(
    text: str, every: int, priority: int = 80, core: int = 1, name: str = "level"
) -> TimedTask:
    return TimedTask(name, name, "executor", core, priority, every, parts(text))


def planner(
    text: str, every: int, cycles: int, core: int = 1, ceiling: int = 80, name: str = "level"
) -> TimedTask:
    return TimedTask(
        f"{name}.planner", name, "planner", core, 0, every, parts(text, "U"), cycles, ceiling
    )


def row(chart: Chart, core: int = 1) -> str:
    """Return the unit function of each unit of time, as in the paper's figures."""
    letters = ["-"] * chart.end_ns
    for span in (span for span in chart.spans if span.core == core):
        letters[span.start_ns : span.end_ns] = span.unit.value * (span.end_ns - span.start_ns)
    return "".join(letters)


def ends(chart: Chart, task: str) -> list[tuple[int, int | None]]:
    return [(job.release_ns, job.end_ns) for job in chart.jobs if job.task == task]


FIG_2 = (executor("R1 X2 W1", 8), planner("P6 U1", 8, 2))
FIG_3 = (executor("R1 X2 W1", 6), planner("P6 U1", 6, 3))
FIG_4 = (executor("C1 R1 X2 W1", 6), planner("P6 U1", 6, 2, core=2, ceiling=0))


def test_figure_2_is_as_in_the_paper() -> None:
    assert row(simulate_schedule(FIG_2, 32)) == "RXXWPPPPRXXWPPU-" * 2


def test_figure_4_works_on_two_processors_with_waste() -> None:
    chart = simulate_schedule(FIG_4, 24)
    assert row(chart, 1) == "CRXXW-" * 4
    assert row(chart, 2) == "PPPPPPU-----" * 2
    assert not chart.list_late_jobs("level")
    assert not chart.list_late_jobs("level.planner")
    # A longer executor misses every cycle.
    chart = simulate_schedule((executor("C1 R1 X4 W1", 6), FIG_4[1]), 60)
    assert row(chart, 1) == ("CRXXXXW" * 9)[:60]
    assert len(chart.list_late_jobs("level")) == 10


def test_figure_3_has_no_plan_within_three_cycles() -> None:
    chart = simulate_schedule(FIG_3, 180)
    assert row(chart)[:24] == "RXXWPPRXXWPPRXXWPPRXXWUP"
    plans = [job for job in chart.jobs if job.task == "level.planner"]
    assert len(plans) == 9
    assert chart.list_late_jobs("level.planner") == plans
    assert not chart.list_late_jobs("level")


def test_every_job_costs_two_context_switches() -> None:
    chart = simulate_schedule(FIG_2, 16, context_switch_ns=1)
    # in, R X W, out; in, P; in, R X W, out; P: the rest of two cycles is six units, one of them a
    # switch.
    assert row(chart) == "-RXXW--P-RXXW-PP"
    assert ends(chart, "level") == [(0, 5), (8, 13)]
    assert [job.end_ns for job in chart.list_late_jobs("level.planner")] == [None]


def test_ordinary_tasks_take_turns() -> None:
    tasks = [executor("X5", 20, priority=0, name=name) for name in "ab"]
    long = [replace(t, parts=(Part(Unit.PROCESS, 10_000_000),), every_ns=40_000_000) for t in tasks]
    chart = simulate_schedule(long, 40_000_000)
    spans = [(span.task, span.start_ns // 1_000_000, span.end_ns) for span in chart.spans]
    assert [(task, start) for task, start, _ in spans] == [
        *(("a", 0), ("b", 4), ("a", 8), ("b", 12), ("a", 16), ("b", 18))
    ]
    assert spans[-1][2] == 20_000_000
    # Shorter jobs end within their turns.
    assert row(simulate_schedule(tasks, 20)) == "X" * 10 + "-" * 10


def test_a_late_task_keeps_its_place_before_others_of_its_priority() -> None:
    # It never waits for a release, so SCHED_FIFO does not move it behind the others.
    chart = simulate_schedule((executor("X6", 5, name="a"), executor("W1", 5, name="b")), 20)
    assert row(chart) == "X" * 20
    # A task that has waited in time runs in between.
    chart = simulate_schedule((executor("X5", 6, name="a"), executor("W2", 5, name="b")), 20)
    assert row(chart)[:9] == "XXXXXWWXX"


def random_tasks(seed: int) -> list[TimedTask]:
    """Return two to five tasks on one core, with room for them or without."""
    chance = random.Random(seed)
    tasks = []
    for at in range(chance.randint(1, 3)):
        every, priority = chance.randint(4, 20), chance.choice((10, 20, 30, 40))
        longest = max(1, every // 3)
        text = f"R{chance.randint(0, 1)} X{chance.randint(1, longest)} W{chance.randint(0, 2)}"
        name = f"level{at}"
        tasks.append(executor(text, every, priority, name=name))
        if chance.random() < 0.7:
            plan = f"P{chance.randint(0, 12)} U{chance.randint(1, 4)}"
            ceiling = chance.choice((0, priority))
            tasks.append(planner(plan, every, chance.randint(1, 4), ceiling=ceiling, name=name))
    return tasks


def step_by_step(
    tasks: Sequence[TimedTask], until: int
) -> tuple[list[str], dict[tuple[str, int], int]]:
    """Return the task and part computing in each unit of time, "X of a", and the end of every job
    by task and release.

    It is written from the rules alone, unit by unit: slow, and too simple to be wrong in the same
    way.
    """
    todo: dict[str, list[tuple[str, bool, bool]]] = {task.name: [] for task in tasks}
    release = {task.name: -1 for task in tasks}
    free_from = {task.name: 0 for task in tasks}
    queued_at = {task.name: 0 for task in tasks}
    late_by = {task.name: 0 for task in tasks}
    row, ends = [], {}
    for now in range(until):
        able = [task for task in tasks if todo[task.name] or free_from[task.name] <= now]
        if not able:
            row.append("-")
            continue
        task = min(able, key=lambda task: place(task, todo[task.name], queued_at[task.name]))
        name = task.name
        if not todo[name]:
            newest = now - now % task.every_ns
            release[name] = max(free_from[name], newest - late_by[name])
            late_by[name] = (task.within_cycles - 1) * task.every_ns
            for part in task.parts:
                letter, is_whole = part.unit.value, not part.preemptible
                todo[name] += [(letter, is_whole, at > 0) for at in range(part.time_ns)]
        letter, _, _ = todo[name].pop(0)
        row.append(f"{letter} of {name}")
        if not todo[name]:
            ends[name, release[name]] = now + 1
            free_from[name] = release[name] + task.period_ns
            if free_from[name] > now + 1:
                queued_at[name] = free_from[name]
    return row, ends


def place(
    task: TimedTask, todo: list[tuple[str, bool, bool]], since: int
) -> tuple[int, int, int, str]:
    """Return the order in which tasks get the core; the lowest does."""
    is_locked = bool(todo) and todo[0][1] and todo[0][2]
    priority = max(task.priority, task.ceiling) if is_locked else task.priority
    return -priority, 0 if is_locked else 1, since, task.name


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_a_schedule_equals_a_simulation_unit_by_unit(seed: int) -> None:
    for number in range(10):
        tasks, until = random_tasks(1000 * seed + number), 300
        chart = simulate_schedule(tasks, until)
        expected, ended = step_by_step(tasks, until)
        found = ["-"] * until
        for span in chart.spans:
            assert set(found[span.start_ns : span.end_ns]) == {"-"}
            units = span.end_ns - span.start_ns
            found[span.start_ns : span.end_ns] = [f"{span.unit.value} of {span.task}"] * units
        assert found == expected
        done = [job for job in chart.jobs if job.end_ns is not None]
        assert {(job.task, job.release_ns): job.end_ns for job in done} == ended
