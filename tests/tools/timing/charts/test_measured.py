"""The chart of a run: spans that are cut by higher priorities, jobs, and skipped releases."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.boards.timing.schedule import Chart
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import merge_stretches, subtract_stretches
from tests.tools.recordings import cycle, recorded

TICK_US = 2000
"""A tick of the figures' clock, us. A cycle of fig2 has four ticks."""


def executor(number: int, *moments_us: int, **more: int) -> tuple[int, ...]:
    return cycle(4 * number, TICK_US, *moments_us, **more)


def plan(number: int, start: int, process: int, end: int) -> tuple[int, ...]:
    return cycle(4 * number, TICK_US, start, start, start, process, end, planned=True)


def spans(chart: Chart) -> list[tuple[str, int, int]]:
    """Return unit function, start and end, us, of every span."""
    return [(span.unit.value, span.start_ns // 1000, span.end_ns // 1000) for span in chart.spans]


def fig2(
    folder: Path, executor_rows: list[tuple[int, ...]], plans: list[tuple[int, ...]]
) -> TracedRun:
    rows = {"level": executor_rows, "level.planner": plans}
    return TracedRun(recorded(folder / "run", load("fig2"), rows))


def test_a_cycle_becomes_its_unit_functions_at_their_times_on_the_grid(tmp_path: Path) -> None:
    run = fig2(tmp_path, [executor(1, 8100, 8200, 9200, 11_200, 12_200)], [])
    chart = run.build_chart(0, run.end_ns)
    moments = [8100, 8200, 9200, 11_200, 12_200]
    assert spans(chart) == list(zip("CRXW", moments, moments[1:], strict=False))
    assert [(job.release_ns, job.deadline_ns, job.end_ns) for job in chart.jobs] == [
        (8_000_000, 16_000_000, 12_200_000)
    ]
    assert run.end_ns == 16_000_000


def test_a_planner_has_the_core_only_while_its_executor_does_not_run(tmp_path: Path) -> None:
    cycles = [executor(0, 100, 100, 200, 300, 400), executor(1, 8100, 8100, 8200, 8300, 8400)]
    run = fig2(tmp_path, cycles, [plan(0, 500, 9000, 9500)])
    planner = [found for found in spans(run.build_chart(0, run.end_ns)) if found[0] in "PU"]
    assert planner == [("P", 500, 8100), ("P", 8400, 9000), ("U", 9000, 9500)]


def test_wake_up_time_of_an_executor_is_cut_from_its_planner(tmp_path: Path) -> None:
    # 150 us of processor time more than between start and end; released at 8000.
    cycles = [executor(1, 8200, 8200, 8200, 8300, 8400, processor_us=350)]
    run = fig2(tmp_path, cycles, [plan(0, 500, 9000, 9500)])
    planner = [found for found in spans(run.build_chart(0, run.end_ns)) if found[0] == "P"]
    assert planner == [("P", 500, 8050), ("P", 8400, 9000)]
    # The executor cannot wake up before its release.
    cycles = [executor(1, 8200, 8200, 8200, 8300, 8400, processor_us=5000)]
    run = fig2(tmp_path, cycles, [plan(0, 500, 9000, 9500)])
    assert ("P", 500, 8000) in spans(run.build_chart(0, run.end_ns))


def test_skipped_releases_are_jobs_without_an_end(tmp_path: Path) -> None:
    late = executor(3, 24_000, 24_000, 24_000, 24_000, 25_000, skipped=2)
    run = fig2(tmp_path, [executor(0, 0, 0, 0, 0, 21_000), late], [])
    chart = run.build_chart(0, run.end_ns)
    unended = [job.release_ns for job in chart.jobs if job.end_ns is None]
    assert unended == [8_000_000, 16_000_000]
    assert [job.release_ns for job in chart.list_late_jobs("level")] == [0, 8_000_000, 16_000_000]
    counted = run.build_panel(0, run.end_ns, lambda part: None).counts["level"]
    assert (counted.jobs, counted.late, counted.skipped) == (4, 3, 2)


def test_a_release_without_a_plan_is_not_drawn(tmp_path: Path) -> None:
    asked = cycle(4, TICK_US, 8500, 8500, 8550, 8600, 8700, skipped=1)
    run = fig2(tmp_path, [], [plan(0, 500, 6000, 7000), asked])
    chart = run.build_chart(0, 100_000_000)
    assert [job.release_ns for job in chart.jobs] == [0]
    assert spans(chart) == [("P", 500, 6000), ("U", 6000, 7000)]


def test_a_window_shows_spans_that_began_long_before_it(tmp_path: Path) -> None:
    rows = [executor(n, *[n * 8000 + 100] * 4, n * 8000 + 200) for n in range(50)]
    run = fig2(tmp_path, rows, [plan(0, 500, 300_000, 301_000)])
    shown = [found[:2] for found in spans(run.build_chart(200_000_000, 204_000_000))]
    assert shown == [("P", 200_000), ("W", 200_100), ("P", 200_200)]


def test_patterns_and_counts_do_not_depend_on_the_blocks_that_are_read_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [executor(n, *(n * 8000 + at for at in (0, 10, 1000, 3000, 4000))) for n in range(60)]
    plans = [plan(n, *(n * 8000 + at for at in (4000, 14_000, 15_000))) for n in range(0, 60, 2)]
    run = fig2(tmp_path, rows, plans)
    at_once = run.build_panel(0, 1, lambda part: None)
    parts: list[float] = []
    monkeypatch.setattr("rack.tools.timing.charts.measured.BLOCK_NS", 1)
    in_blocks = run.build_panel(0, 1, parts.append)
    assert len(parts) > 10
    assert parts[-1] == 1.0
    assert (in_blocks.patterns, in_blocks.counts) == (at_once.patterns, at_once.counts)
    assert dict(at_once.patterns["level"].plans) == {"R X W P | R X W P U -": 30}


def test_a_stretch_is_divided_into_busy_and_idle_parts() -> None:
    chance = random.Random(5)
    for _ in range(200):
        starts = (chance.randint(0, 60) for _ in range(5))
        taken = merge_stretches((start, start + chance.randint(1, 9)) for start in starts)
        left = list(subtract_stretches((10, 50), taken))
        moments = sorted(at for start, end in [*taken, *left] for at in range(start, end))
        assert [at for at in moments if 10 <= at < 50] == list(range(10, 50))
