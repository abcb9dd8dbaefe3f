"""The window of a chart, and refused windows."""

from __future__ import annotations

import pytest

from rack.boards.timing.tasks import TimedTask
from rack.tools.timing.charts.gantt import WindowOptions, choose_task
from tests.tools.command_line import read_failure

MS = 1_000_000


def task(name: str, every_ms: float, cycles: int = 1) -> TimedTask:
    role = "planner" if name.endswith("planner") else "executor"
    return TimedTask(name, name.partition(".")[0], role, 0, 0, round(every_ms * MS), (), cycles)


NASREM = [
    task("servo", 2.5),
    task("servo.planner", 2.5, 8),
    task("primitive", 20),
    task("primitive.planner", 20, 2),
    task("task", 1000),
    task("task.planner", 1000, 2),
]


def test_a_default_window_shows_two_plans_of_the_slowest_level_that_fits() -> None:
    level = choose_task(NASREM)
    assert level.name == "primitive.planner"
    assert WindowOptions().choose_window(level, None, 40 * MS) == (40 * MS, 120 * MS)


@pytest.mark.parametrize(
    ("from_ms", "to_ms", "extent_ms", "seen"),
    [
        (3.5, 9.25, None, (3.5, 9.25)),
        (3, None, None, (3, 8)),
        # A default window ends with the run at the latest.
        (3, None, 5, (3, 5)),
    ],
)
def test_a_window_begins_and_ends_as_requested(
    from_ms: float, to_ms: float | None, extent_ms: int | None, seen: tuple[float, float]
) -> None:
    extent = None if extent_ms is None else extent_ms * MS
    start, end = build_options(from_ms, to_ms).choose_window(NASREM[0], extent, 0)
    assert (start / MS, end / MS) == seen


def build_options(from_ms: float | None, to_ms: float | None) -> WindowOptions:
    return WindowOptions(*(None if ms is None else round(ms * MS) for ms in (from_ms, to_ms)))


@pytest.mark.parametrize(
    ("from_ms", "to_ms", "extent_ms", "message"),
    [
        (90.0, 95.0, 80, "90 to 95 ms: is outside the run, which lasts from 0 to 80 ms"),
        (70.0, 81.0, 80, "70 to 81 ms: is outside the run"),
        (9.0, 9.0, 80, "9 to 9 ms: --to-ms must be later than --from-ms"),
        # Such a chart would be unreadable.
        (0.0, 5000.1, 9000, "a chart shows at most 2000 cycles of 'servo', 5000 ms"),
    ],
)
def test_a_bad_window_is_refused(
    from_ms: float, to_ms: float, extent_ms: int, message: str
) -> None:
    choose_window = build_options(from_ms, to_ms).choose_window
    assert message in read_failure(choose_window, NASREM[0], extent_ms * MS, 0)
