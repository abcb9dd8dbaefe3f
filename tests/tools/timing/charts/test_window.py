"""Which stretch of time a chart shows, and what is refused."""

from __future__ import annotations

import pytest

from rack.levels.timing.tasks import TimedTask
from rack.tools.console.answer import Failure
from rack.tools.timing.charts.window import WindowOptions, times_of, window_options

MS = 1_000_000


def task(name: str, every_ms: float, cycles: int = 1, core: int = 0, board: str = "") -> TimedTask:
    role = "planner" if name.endswith("planner") else "executor"
    return TimedTask(
        name, board or name.partition(".")[0], role, core, 0, round(every_ms * MS), (), cycles
    )


NASREM = [
    task("servo", 2.5),
    task("servo.planner", 2.5, 8),
    task("primitive", 20),
    task("primitive.planner", 20, 2),
    task("task", 1000),
    task("task.planner", 1000, 2),
]


def test_a_window_shows_two_plans_of_the_slowest_level_whose_neighbours_can_still_be_seen() -> None:
    none = window_options(None, None, None, None)
    level = none.task(NASREM)
    assert level.name == "primitive.planner"
    assert none.window(level, None, 40 * MS) == (40 * MS, 120 * MS)


def test_a_tight_planner_comes_before_a_slower_one_on_another_core() -> None:
    tasks = [
        task("a", 10),
        task("a.planner", 10, 2),
        task("b", 10, core=1),
        task("b.planner", 10, 4, core=0),
    ]
    assert window_options(None, None, None, None).task(tasks).name == "a.planner"


def test_cycles_are_those_of_the_level_that_is_named() -> None:
    asked = window_options(None, None, "3-5", "servo")
    assert asked.window(asked.task(NASREM), None, 0) == (7_500_000, 15 * MS)
    assert window_options(None, None, "7", None).window(asked.task(NASREM), None, 0) == (
        17_500_000,
        20 * MS,
    )


def test_begin_and_end_are_as_they_are_asked_for() -> None:
    assert window_options(3.5, 9.25, None, None).window(NASREM[0], None, 0) == (
        3_500_000,
        9_250_000,
    )
    assert window_options(3, None, None, None).window(NASREM[0], None, 0) == (3 * MS, 8 * MS)
    # A default end is cut at the end of the run.
    assert window_options(3, None, None, None).window(NASREM[0], 5 * MS, 0) == (3 * MS, 5 * MS)


def seen(asked: WindowOptions) -> tuple[int, int]:
    return asked.window(asked.task(NASREM), 80 * MS, 0)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ((90.0, 95.0, None, None), "90 to 95 ms: outside the run, which lasts from 0 to 80 ms"),
        ((70.0, 81.0, None, None), "70 to 81 ms: outside the run"),
        ((None, None, "31-32", "servo"), "77.5 to 82.5 ms: outside the run"),
        ((9.0, 9.0, None, None), "9 to 9 ms: --to-ms must be later than --from-ms"),
        (
            (None, None, None, "arm"),
            "--level arm: no such level in the chart; levels: servo, primitive, task",
        ),
    ],
)
def test_a_bad_window_is_refused(asked: tuple[float, float, str, str], message: str) -> None:
    with pytest.raises(Failure, match=message) as failure:
        seen(window_options(*asked))
    assert failure.value.status == 2


def test_a_chart_nobody_could_read_is_refused() -> None:
    asked = window_options(0.0, 5000.1, None, "servo")
    with pytest.raises(Failure, match="a chart shows at most 2000 cycles of 'servo', 5000 ms"):
        asked.window(asked.task(NASREM), None, 0)


@pytest.mark.parametrize("cycles", ["x", "5-3", "-3", "3-", "1.5", ""])
def test_bad_cycles_are_refused(cycles: str) -> None:
    with pytest.raises(Failure, match="give the first and the last cycle"):
        window_options(None, None, cycles, None)


def test_cycles_and_times_do_not_go_together() -> None:
    with pytest.raises(Failure, match="--cycles already gives the window"):
        window_options(1.0, None, "3", None)


def test_times_of_x_are_read_by_level() -> None:
    assert times_of(["level=3,2", "servo=0.5"]) == {"level": [3 * MS, 2 * MS], "servo": [500_000]}


@pytest.mark.parametrize(
    "text", ["level", "level=", "level=a", "level=1,-1", "level=nan", "level=inf", "level=1,,2"]
)
def test_bad_times_are_refused(text: str) -> None:
    with pytest.raises(Failure, match=f"--process {text}: give a level and its times"):
        times_of([text])
