"""The bench of launches: the first cycle of a run, and the reactions to a kill."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rack.boards.config import load
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.launch import find_fastest_board, find_first_cycle_ns, measure_kills

pytestmark = pytest.mark.thorough


def write_trace(folder: Path, tasks: list[str], started_ns: list[int]) -> Path:
    """Write the trace of a run as another version of the program records it."""
    pq.write_table(pa.table({"task": tasks, "start_ns": started_ns}), folder / "cycles.parquet")
    return folder


def test_the_first_cycle_is_the_earliest_of_its_task(tmp_path: Path) -> None:
    run = write_trace(tmp_path, ["servo", "task", "servo", "servo"], [70, 10, 50, 60])
    assert find_first_cycle_ns(run, "servo") == 50


def test_a_run_without_a_cycle_of_the_task_is_a_failure(tmp_path: Path) -> None:
    with pytest.raises(Failure, match="no cycle of 'servo' was recorded"):
        find_first_cycle_ns(write_trace(tmp_path, ["task"], [10]), "servo")


def test_the_board_with_the_shortest_period_is_found(small: Path) -> None:
    assert find_fastest_board(load(small)) == "lower"
    assert find_fastest_board(load("nasrem")) == "servo"


def test_a_rack_without_an_arm_has_no_brakes(small: Path) -> None:
    with pytest.raises(Failure, match="no arm whose brakes could engage"):
        measure_kills(str(small), 1)


@pytest.mark.alone
def test_a_kill_is_detected_and_the_brakes_engage() -> None:
    detected, braked = measure_kills("nasrem", 2)
    assert {one.case for one in (detected, braked)} == {"servo killed"}
    assert [(one.who, one.count, one.unit) for one in (detected, braked)] == [
        ("detected", 2, "ms"),
        ("brakes engaged", 2, "ms"),
    ]
    assert min(detected.values) > 0.0
    assert 0.0 < max(braked.values) < 1000.0
