"""Figures 2 to 4 by real processes in real time: the runs agree with the predictions.

The machine takes cores away for some milliseconds now and then: these tests judge by majorities,
without time limits.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, rack_timing, wire
from rack.levels.timing.tasks import Unit
from rack.levels.timing.verdicts import verdicts
from rack.tools.timing.charts.measured import TracedRun
from rack.tools.timing.charts.panel import Panel
from rack.tools.timing.charts.scheduled import Schedule
from tests.machine import needs_fifo, needs_two_cores
from tests.tools.figure_runs import SLOWER, run, slowed, undisturbed, usual, whole

pytestmark = [
    needs_fifo,
    needs_two_cores,
    pytest.mark.alone,
    pytest.mark.thorough,
    pytest.mark.timeout(300),
]
FIGURES = ("fig2", "fig3", "fig4", "fig4-overload")
MOSTLY = 0.7
ENOUGH = 5
"""Plan updates from which on a majority is significant."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TracedRun]:
    # An overloaded executor waits for itself: the influence of other programs cannot be measured.
    folders = {name: tmp_path_factory.mktemp("runs") for name in FIGURES}
    found = {name: undisturbed(name, folders[name]) for name in FIGURES[:3]}
    overload = FIGURES[3]
    return found | {overload: run(overload, folders[overload], *slowed(overload))}


@pytest.fixture(scope="module")
def panels(runs: dict[str, TracedRun]) -> dict[str, Panel]:
    return {name: whole(found) for name, found in runs.items()}


def late(panel: Panel, task: str) -> float:
    """Return the part of a task's jobs that were late."""
    count = panel.counts[task]
    return count.late / count.jobs


@pytest.mark.slow
def test_figure_2_repeats_its_pattern_and_plans_in_time(panels: dict[str, Panel]) -> None:
    assert usual(panels["fig2"].patterns["level"].plans) == "R X W P | R X W P U -"
    assert late(panels["fig2"], "level.planner") < 1 - MOSTLY
    assert late(panels["fig2"], "level") < 1 - MOSTLY


def test_figure_3_misses_every_plan_and_no_cycle(panels: dict[str, Panel]) -> None:
    plans = panels["fig3"].counts["level.planner"]
    # The end of the run may cut the last one off.
    assert plans.late >= plans.jobs - 1 > 5
    assert late(panels["fig3"], "level") < 1 - MOSTLY


def test_figure_4_has_an_idle_executor_beside_a_planner_that_is_in_time(
    panels: dict[str, Panel],
) -> None:
    panel = panels["fig4"]
    assert [(lane.core, lane.name) for lane in panel.lanes] == [(0, "level.planner"), (1, "level")]
    assert usual(panel.patterns["level"].cycles) == "C R X W -"
    assert usual(panel.patterns["level.planner"].plans) == "P U -"
    assert max(late(panel, "level"), late(panel, "level.planner")) < 1 - MOSTLY


def test_figure_4_with_a_longer_executor_misses_cycles_though_its_planner_is_in_time(
    panels: dict[str, Panel],
) -> None:
    panel = panels["fig4-overload"]
    assert late(panel, "level") > MOSTLY
    assert panel.counts["level"].skipped > 0
    assert late(panel, "level.planner") < 1 - MOSTLY


@pytest.mark.parametrize("name", FIGURES)
def test_what_is_predicted_to_fail_fails_in_the_run_and_nothing_else(
    name: str, panels: dict[str, Panel]
) -> None:
    config = load(name)
    layout = wire(config)
    predicted = all(verdict.holds for verdict in verdicts(rack_timing(config, layout)))
    schedule = Schedule(config, layout, {}).panel(0, 1)
    scheduled = not any(count.late for count in schedule.counts.values())
    seen = max(late(panels[name], task) for task in ("level", "level.planner")) < 1 - MOSTLY
    assert predicted == scheduled == seen == (name in ("fig2", "fig4"))


def updates_met(found: TracedRun) -> tuple[int, int]:
    """Return how many plan updates their executor was released in, and how many of them it cut in
    two.

    An executor that begins later than an update takes began after it.
    """
    executor, planner = (found.recording.cycles[task] for task in ("level", "level.planner"))
    met = cut = 0
    for plan in planner:
        start, end = plan["process_ns"], plan["process_ns"] + UPDATE_NS
        in_it = (executor["release_ns"] > start) & (executor["release_ns"] < end)
        met += bool(in_it.any())
        cut += bool((in_it & (executor["start_ns"] < end)).any())
    return met, cut


# P ends 1 ms or less before the third cycle begins, however slow the machine is: U, of 2 ms,
# reaches into that.
STRADDLING = (
    f"board.level.params.process_ms={SLOWER * 2.0}",
    f"board.level.params.plan_ms={SLOWER * 6.4}",
    (
        f"board.level.transfer={{ read_ms = {SLOWER}, write_ms = {SLOWER}, update_ms ="
        f" {SLOWER * 2.0} }}"
    ),
    "board.level.within_cycles=3",
)
UPDATE_NS = SLOWER * 1_900_000


@pytest.mark.slow
def test_the_update_of_a_plan_keeps_its_executor_waiting(tmp_path: Path) -> None:
    found = undisturbed("fig2", tmp_path, *STRADDLING)
    met, cut = updates_met(found)
    assert met > ENOUGH
    assert cut < (1 - MOSTLY) * met
    # In the chart too such an update is of one piece.
    updates = [span for span in found.chart(0, found.end_ns).spans if span.unit is Unit.UPDATE]
    assert sum(span.end_ns - span.start_ns > UPDATE_NS for span in updates) > MOSTLY * met
