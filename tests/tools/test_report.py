"""Reports: the numbers of a run, from its recording alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from backplane.layout import TaskSpec
from backplane.trace import RECORD
from boards.config import load
from tools.display import SilentDisplay
from tools.reporting.report import write_report
from tools.reporting.timing import plan_age_ms, task_times
from tools.running import run_rack
from tools.timing.prediction import response_ticks

TASK = TaskSpec("servo", "servo", "executor", 2, 0, 0, 1, 1, 64)
MS = 1_000_000


def cycle(tick: int, late: float, read: float, process: float, write: float) -> tuple[int, ...]:
    """Return a trace record of a cycle of a 10 ms task, of times in ms."""
    release = tick * 10 * MS
    times = np.cumsum([release, late * MS, 0, read * MS, process * MS, write * MS]).astype(int)
    return (tick, *times.tolist(), 0, 0, round((read + process + write) * MS))


def test_times_of_a_task_are_those_of_equation_3_5() -> None:
    cycles = np.array([cycle(0, 1, 0.5, 3, 0.5), cycle(1, 2, 1, 4, 1), cycle(2, 0, 0.5, 2, 0.5)], RECORD)
    times = task_times(TASK, cycles, 10 * MS)
    assert (times["lateness_ms"]["max"], times["lateness_ms"]["p50"]) == (2.0, 1.0)
    assert (times["execution_ms"]["min"], times["execution_ms"]["max"]) == (2.0, 4.0)
    assert times["communication_ms"]["max"] == 2.0
    # 10 ms less lateness, execution and communication: the worst cycle is the second.
    assert times["residual_ms"]["min"] == 2.0
    assert times["largest_gap_ms"] == 11.0
    assert times["alpha_ms"] == 4.0


def test_a_task_that_never_ran_has_no_times() -> None:
    times = task_times(TASK, np.empty(0, RECORD), 10 * MS)
    assert times["execution_ms"] is None
    assert times["alpha_ms"] is None


def test_a_plan_ages_until_the_next_one_can_be_read() -> None:
    executor, made, visible_at = np.arange(20), np.array([0, 8]), np.array([4, 12])
    ages = plan_age_ms(executor, made, visible_at, 2.5)
    # Plan 0 is read in ticks 4 to 11, plan 8 in 12 to 19.
    assert (ages["min"], ages["max"]) == (4 * 2.5, 11 * 2.5)


@pytest.mark.parametrize(
    ("cycles", "ticks"),
    [
        ([8], 8),
        ([400, 100, 8, 1], 509 + 4),  # 100 and 8 meet every 4 ticks only
        ([1, 8, 100, 400], 509 + 7 + 96 + 300),
    ],
)
def test_response_is_the_sum_of_the_cycles_and_of_the_waits_for_the_grid(cycles: list[int], ticks: int) -> None:
    assert response_ticks(cycles) == ticks


def test_measured_response_of_a_run_meets_its_prediction(small: Path, rack_name: str, tmp_path: Path) -> None:
    config = load(small, [f"name={rack_name}", "board.upper.rate_hz=10", "board.lower.rate_hz=80"])
    result = run_rack(config, 5.0, tmp_path / "run", SilentDisplay())
    report, text = write_report(tmp_path / "run")
    response = report["system_response"]
    assert response["levels"] == ["upper", "lower"]
    # 40 and 5 ticks: a command takes both cycles, a status waits for up to 35 ticks more.
    assert response["command"]["bound_ms"] == 45 * 2.5
    assert response["command"]["measured_ms"]["max"] == 45 * 2.5
    assert response["status"]["bound_ms"] == 80 * 2.5
    assert response["status"]["measured_ms"]["max"] == 80 * 2.5
    assert report["digest"] == result.outcome.digest
    assert report["tasks"]["lower"]["cycles"] == 400
    assert json.loads((tmp_path / "run" / "report.json").read_text()) == report
    assert result.outcome.digest in text
