"""Patterns: the order of unit functions in plans and in cycles."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.boards.timing.schedule import Chart, Job, Span, simulate_schedule
from rack.boards.timing.tasks import Part, TimedTask, Unit
from rack.tools.timing.charts.patterns import (
    Lane,
    PatternDetail,
    Patterns,
    build_lanes,
    count_patterns,
)


def task(name: str, text: str, every: int, cycles: int = 1, priority: int = 80) -> TimedTask:
    parts = tuple(Part(Unit(part[0]), int(part[1:])) for part in text.split())
    role = "planner" if name.endswith("planner") else "executor"
    return TimedTask(name, name.partition(".")[0], role, 1, priority, every, parts, cycles)


EXECUTOR = task("a", "R100 X200 W100", 800)
PLANNER = task("a.planner", "P600 U100", 800, 2, priority=0)


def count(tasks: list[TimedTask], lane: str, end: int) -> Patterns:
    chart = simulate_schedule(tasks, 2 * end)
    found = next(found for found in build_lanes(tasks) if found.name == lane)
    return count_patterns(chart, found, (0, end), PatternDetail())


def test_a_plan_has_one_pattern_over_all_its_cycles() -> None:
    found = count([EXECUTOR, PLANNER], "a", 16_000)
    assert dict(found.plans) == {"R X W P | R X W P U -": 10}
    assert not found.cycles


def test_a_planner_on_a_separate_core_has_no_cycles_and_its_executor_no_plans() -> None:
    tasks = [EXECUTOR, replace(PLANNER, core=2)]
    assert dict(count(tasks, "a.planner", 16_000).plans) == {"P U -": 10}
    alone = count(tasks, "a", 16_000)
    assert (dict(alone.plans), dict(alone.cycles)) == ({}, {"R X W -": 20})


def test_cycles_in_which_no_plan_is_under_way_are_counted_apart() -> None:
    chart = simulate_schedule([EXECUTOR, PLANNER], 8000)
    # Remove the jobs and spans of the last three of five plans.
    kept = tuple(job for job in chart.jobs if job.task == "a" or job.release_ns < 3200)
    spans = tuple(span for span in chart.spans if span.task == "a" or span.release_ns < 3200)
    lane, cut = build_lanes([EXECUTOR, PLANNER])[0], Chart(0, 8000, spans, kept)
    found = count_patterns(cut, lane, (0, 6400), PatternDetail())
    assert dict(found.plans) == {"R X W P | R X W P U -": 2}
    assert dict(found.cycles) == {"R X W -": 4}


def test_a_core_that_another_board_has_is_not_idle() -> None:
    other = task("b", "X400", 800, priority=70)
    assert dict(count([EXECUTOR, other], "a", 8000).cycles) == {"R X W": 10}
    assert dict(count([EXECUTOR, other], "b", 8000).cycles) == {"X": 10}


LANE = Lane(1, "a", "a", None, 80, 1000, 1000, 0)


def find_pattern(*stretches: tuple[str, int, int], detail: PatternDetail) -> str:
    spans = tuple(Span("a", 1, Unit(unit), start, end, 0) for unit, start, end in stretches)
    chart = Chart(0, 2000, spans, (Job("a", 0, 1000, 900),))
    (pattern,) = count_patterns(chart, LANE, (0, 1000), detail).cycles
    return pattern


def test_measured_patterns_leave_out_remnants_and_short_gaps() -> None:
    detail = PatternDetail.from_medians(LANE, {Unit.PLAN: 300, Unit.READ: 20})
    measured = (("P", 0, 15), ("R", 60, 75), ("X", 75, 400), ("P", 420, 990))
    assert find_pattern(*measured, detail=detail) == "R X P"
    assert find_pattern(*measured, detail=PatternDetail()) == "P - R X - P -"


@pytest.mark.parametrize("start", [0, 1, 799, 800])
def test_patterns_begin_on_the_grid_and_in_the_stretch(start: int) -> None:
    chart, lane = simulate_schedule([EXECUTOR], 8000), build_lanes([EXECUTOR])[0]
    found = count_patterns(chart, lane, (start, 4000), PatternDetail())
    assert found.cycles.total() == (5 if start == 0 else 4)
