"""Measured budgets, on synthetic traces and on racks that compute for known times."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from rack.backplane.trace import Flag
from rack.boards.config import RackConfig, load
from rack.boards.timing.tasks import Budget
from rack.tools.console.answer import Failure
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.cycles import measure_budgets
from rack.tools.recording.recording import Recording
from tests.tools.recordings import MS, Cycle, recorded

PLANNED = int(Flag.PLANNED)
SETTLED = 40
"""Tick from which on a process of a rack with a clock of 2.5 ms has started up."""
PLAIN = (0.0, 0.1, 1.0, 0.2)


@pytest.fixture
def config(small: Path) -> RackConfig:
    """Two levels on one core in real time, the lower one at 400 Hz, with its planner below both."""
    settings = ["clock.mode=realtime", "board.lower.priority=80", "board.upper.priority=70"]
    return load(small, settings)


def test_undisturbed_cycles_have_the_times_of_their_stamps(
    config: RackConfig, tmp_path: Path
) -> None:
    trace = [
        Cycle(SETTLED + k, (0.05, 0.1, 1.0 + 0.1 * k, 0.2), processor=1.5 + 0.1 * k)
        for k in range(4)
    ]
    found = measure_budgets(recorded(tmp_path / "run", config, {"lower": trace}))
    assert found == {
        "lower": Budget(
            read_ns=MS // 10, process_ns=1_300_000, write_ns=MS // 5, exchange_ns=MS // 20
        ),
    }


def test_preemption_by_the_executor_is_not_planner_time(config: RackConfig, tmp_path: Path) -> None:
    executor = [Cycle(SETTLED + k, PLAIN) for k in range(4)]
    # Released with the executor's first cycle: 1.3 ms pass before it runs, 1.3 ms each in P and in
    # U.
    plan = Cycle(SETTLED, (0.0, 0.1, 3.1, 2.6), late=1.4, processor=3.2, flags=PLANNED)
    recording = recorded(tmp_path / "run", config, {"lower": executor, "lower.planner": [plan]})
    found = measure_budgets(recording)["lower"]
    # Reading is part of P. U began at 6 ms and was preempted from 7.5 ms on.
    assert found.plan_ns == round((0.1 + 1.8) * MS)
    assert found.update_ns == round(1.3 * MS)


def test_untraced_time_is_subtracted_from_unusually_long_parts(
    config: RackConfig, tmp_path: Path
) -> None:
    usual = [Cycle(SETTLED + k, PLAIN) for k in range(10)]
    stolen = Cycle(SETTLED + 10, (0.0, 0.1, 1.0, 1.2), processor=1.3)
    found = measure_budgets(recorded(tmp_path / "run", config, {"lower": [*usual, stolen]}))[
        "lower"
    ]
    assert (found.process_ns, found.write_ns) == (MS, MS // 5)


def test_the_start_up_of_a_process_is_not_counted(config: RackConfig, tmp_path: Path) -> None:
    cold = (0.0, 0.1, 2.2, 0.2)
    ticks = [*range(60), *range(80, 140)]
    trace = [Cycle(tick, cold if tick in (0, 39, 80, 119) else PLAIN) for tick in ticks]
    event = {"kind": "recovery", "code": "rejoined", "time_ns": 0, "text": ""}
    rejoined, other = event | {"board": "lower", "tick": 80}, event | {"board": "upper", "tick": 45}
    found = measure_budgets(
        recorded(tmp_path / "run", config, {"lower": trace}, [rejoined, other])
    )["lower"]
    assert found.process_ns == MS
    late = [Cycle(tick, cold if tick == 45 else PLAIN) for tick in ticks]
    found = measure_budgets(
        recorded(tmp_path / "late", config, {"lower": late}, [rejoined, other])
    )["lower"]
    assert found.process_ns == 2_200_000


def test_a_recording_without_the_new_times_is_refused_in_one_line(
    config: RackConfig, tmp_path: Path
) -> None:
    folder = recorded(tmp_path / "run", config, {"lower": [Cycle(SETTLED, PLAIN)]}).folder
    table = pq.read_table(folder / "cycles.parquet")
    pq.write_table(table.drop_columns(["plan_ns", "processor_ns"]), folder / "cycles.parquet")
    Checksums(folder).store("cycles.parquet")
    with pytest.raises(Failure, match="no column 'plan_ns'") as refused:
        Recording(folder)
    assert refused.value.status == 2
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def measured_run(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Recording:
    """A run of fig2 with an executor of 1 ms, in the mode that the fixture's parameter names."""
    folder = tmp_path_factory.mktemp("figure") / "run"
    settings = [
        f"name=test-cycles-{os.getpid()}",
        f"clock.mode={request.param}",
        "board.level.params.process_ms=1.0",
    ]
    assert run_rack(load("fig2", settings), 0.8, folder, Display()).outcome.cause == "time over"
    return Recording(folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    "measured_run",
    [pytest.param("realtime", marks=pytest.mark.thorough), "lockstep"],
    indirect=True,
)
def test_measured_times_match_known_computing_times(measured_run: Recording) -> None:
    # Use the median, so that a host that takes the machine away does not fail this test.
    found = measure_budgets(measured_run, 50.0)["level"]
    expected = {
        "read_ns": 1.0,
        "process_ns": 1.0,
        "write_ns": 1.0,
        "plan_ns": 6.0,
        "update_ns": 1.0,
    }
    # Each access and each reading of the clock adds some time.
    assert {name: getattr(found, name) / MS for name in expected} == pytest.approx(
        expected, rel=0.08, abs=0.15
    )
