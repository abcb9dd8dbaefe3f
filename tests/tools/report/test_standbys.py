"""A recording tells which copy of a replicated board was active, since when and why; and a run
continues it, before and after its hand-overs, to the same digest."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.tools.report.summary import format_run_summary
from rack.tools.viewer.reading import read_component
from tests.shared_runs import CLOCK_LOST_AT, LOWER_LOST_AT, standby_run
from tests.tools.command_line import read_answer

pytestmark = pytest.mark.slow
LOST = "the active copy was lost"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return standby_run(tmp_path_factory)


def test_the_report_tells_the_active_copies(run: Path) -> None:
    report = read_answer("report", run)
    assert [
        (each["task"], each["active"], each["since_tick"], each["why"], each["hand_overs"])
        for each in report["standbys"]
    ] == [
        ("upper", "upper", 0, "", 0),
        ("lower", "lower.standby", LOWER_LOST_AT, LOST, 1),
        ("clock", "clock.standby", CLOCK_LOST_AT, LOST, 1),
    ]
    tick_s = report["clock_ms"] * 1e-3
    at_s = LOWER_LOST_AT * tick_s
    text = " ".join(" ".join(format_run_summary(report)).split())
    assert f"lower.standby active since {at_s:g} s (tick {LOWER_LOST_AT}): {LOST}" in text
    assert "upper active throughout" in text


@pytest.mark.parametrize(
    ("board", "copies"),
    [
        ("2-lower", [(0, "lower"), (LOWER_LOST_AT, "lower.standby")]),
        ("1-upper", [(0, "upper")]),
        ("clock", [(CLOCK_LOST_AT, "clock.standby")]),
    ],
)
def test_the_viewer_has_a_lane_of_active_copies(
    run: Path, board: str, copies: list[tuple[int, str]]
) -> None:
    lane = read_component(run / "run.rrd", f"/events/{board}/active", "StateChange:state")
    assert [*zip(lane.ticks.tolist(), lane.values.ravel().tolist(), strict=True)] == copies


@pytest.mark.parametrize(
    "tick",
    [
        pytest.param(LOWER_LOST_AT - 1, marks=pytest.mark.thorough),
        LOWER_LOST_AT + 40,
        pytest.param(CLOCK_LOST_AT + 40, marks=pytest.mark.thorough),
    ],
)
def test_a_run_continues_a_run_with_hand_overs_to_its_digest(
    run: Path, tmp_path: Path, tick: int
) -> None:
    known = read_answer("report", run)
    at_s = tick * known["clock_ms"] * 1e-3
    words = ("--seconds", known["simulated_s"], "--out", tmp_path / "again")
    again = read_answer("run", "--from", f"{run}@{at_s:g}", *words)
    assert (again["digest"], again["failures"]) == (known["digest"], [])
    assert again["standbys"] == known["standbys"]
