"""The bench of launches: what it reads from a run, and both reactions to a kill."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rack.boards.config import load
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.checkout import rack_commands
from rack.tools.lab.benches.kill import DETECTED, SAFE, Killing
from rack.tools.lab.benches.launch import BOUND_S, ShortRuns, fastest, first_cycle_ns

pytestmark = pytest.mark.thorough


def recorded(folder: Path, tasks: list[str], started_ns: list[int]) -> Path:
    """A run's folder, of which another version of the program has recorded the trace."""
    pq.write_table(pa.table({"task": tasks, "start_ns": started_ns}), folder / "cycles.parquet")
    return folder


def test_the_first_cycle_is_the_earliest_of_its_task(tmp_path: Path) -> None:
    run = recorded(tmp_path, ["servo", "task", "servo", "servo"], [70, 10, 50, 60])
    assert first_cycle_ns(run, "servo") == 50


def test_a_run_without_a_cycle_of_the_task_is_a_failure(tmp_path: Path) -> None:
    with pytest.raises(Failure, match="no cycle of 'servo' was recorded"):
        first_cycle_ns(recorded(tmp_path, ["task"], [10]), "servo")


def test_the_fastest_executor_is_looked_for(small: Path) -> None:
    assert fastest(load(small)) == "lower"
    assert fastest(load("nasrem")) == "servo"


@pytest.mark.slow
def test_a_launch_takes_longer_than_nothing_and_leaves_no_folder(
    small: Path, tmp_path: Path
) -> None:
    (tmp_path / "runs").mkdir()
    assert 0.0 < ShortRuns(tmp_path / "runs").launch_s(rack_commands(None)[0], str(small)) < BOUND_S
    assert not list((tmp_path / "runs").iterdir())


def test_a_rack_without_an_arm_has_no_brakes(small: Path) -> None:
    with pytest.raises(Failure, match="no arm whose brakes could engage"):
        Killing(str(small), 1, Progress())


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize("of", ["the arm", "its commands"])
def test_a_kill_is_detected_before_the_brakes_are_engaged(of: str) -> None:
    killing = Killing("nasrem", 2, Progress())
    assert killing.boards == ("servo", "primitive")
    board = killing.boards[of == "its commands"]
    samples = {(sample.who, sample.unit): sample for sample in killing.samples(board)}
    assert {who for who, _ in samples} == {DETECTED, SAFE}
    assert all(sample.count == 2 for sample in samples.values())
    # nasrem's servo level cycles every 2.5 ms.
    for who in (DETECTED, SAFE):
        assert samples[who, "ms"].median == pytest.approx(2.5 * samples[who, "cycles"].median)
    assert all(value > 0.0 for value in samples[DETECTED, "ms"].values)
