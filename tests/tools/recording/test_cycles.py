"""Measured budgets, on synthetic traces and on racks that compute for known times."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from rack.backplane.trace import Flag
from rack.boards.config import load
from rack.boards.timing.tasks import Budget
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.cycles import measure_budgets
from rack.tools.recording.recording import Recording
from tests.tools.command_line import read_failure
from tests.tools.conftest import Record
from tests.tools.recordings import MS, Cycle

PLANNED = int(Flag.PLANNED)
SETTLED = 40
"""Tick from which on a process of a rack with a clock of 2.5 ms has started up."""
PLAIN = (0.0, 0.1, 1.0, 0.2)


Measure = Callable[..., Mapping[str, Budget]]


@pytest.fixture
def measure(record: Record) -> Measure:
    """Measure the budgets of two levels on one core in real time.

    The lower one runs at 400 Hz, with its planner below both.
    """
    priorities = ("board.lower.priority=80", "board.upper.priority=70")
    return lambda *events, **traces: measure_budgets(record(traces, *priorities, events=events))


def test_undisturbed_cycles_have_the_times_of_their_stamps(measure: Measure) -> None:
    trace = [
        Cycle(SETTLED + k, (0.05, 0.1, 1.0 + 0.1 * k, 0.2), processor=1.5 + 0.1 * k)
        for k in range(4)
    ]
    times = Budget(read_ns=MS // 10, process_ns=1_300_000, write_ns=MS // 5, exchange_ns=MS // 20)
    assert measure(lower=trace) == {"lower": times}


def test_preemption_by_the_executor_is_not_planner_time(measure: Measure) -> None:
    executor = [Cycle(SETTLED + k, PLAIN) for k in range(4)]
    # Released with the executor's first cycle: 1.3 ms pass before it runs, 1.3 ms each in P and in
    # U.
    plan = Cycle(SETTLED, (0.0, 0.1, 3.1, 2.6), late=1.4, processor=3.2, flags=PLANNED)
    found = measure(**{"lower": executor, "lower.planner": [plan]})["lower"]
    # Reading is part of P. U began at 6 ms and was preempted from 7.5 ms on.
    assert found.plan_ns == round((0.1 + 1.8) * MS)
    assert found.update_ns == round(1.3 * MS)


def test_untraced_time_is_subtracted_from_unusually_long_parts(measure: Measure) -> None:
    usual = [Cycle(SETTLED + k, PLAIN) for k in range(10)]
    stolen = Cycle(SETTLED + 10, (0.0, 0.1, 1.0, 1.2), processor=1.3)
    found = measure(lower=[*usual, stolen])["lower"]
    assert (found.process_ns, found.write_ns) == (MS, MS // 5)


def test_the_start_up_of_a_process_is_not_counted(measure: Measure) -> None:
    cold = (0.0, 0.1, 2.2, 0.2)
    ticks = [*range(60), *range(80, 140)]
    event = {"kind": "recovery", "code": "rejoined", "time_ns": 0, "text": ""}
    rejoined, other = event | {"board": "lower", "tick": 80}, event | {"board": "upper", "tick": 45}
    for cold_ticks, process_ns in (((0, 39, 80, 119), MS), ((45,), 2_200_000)):
        trace = [Cycle(tick, cold if tick in cold_ticks else PLAIN) for tick in ticks]
        assert measure(rejoined, other, lower=trace)["lower"].process_ns == process_ns


def test_a_recording_without_the_new_times_is_refused_in_one_line(record: Record) -> None:
    folder = record({"lower": [Cycle(SETTLED, PLAIN)]}).folder
    table = pq.read_table(folder / "cycles.parquet")
    pq.write_table(table.drop_columns(["plan_ns", "processor_ns"]), folder / "cycles.parquet")
    Checksums(folder).store("cycles.parquet")
    assert "no column 'plan_ns'" in read_failure(Recording, folder)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [pytest.param("realtime", marks=pytest.mark.thorough), "lockstep"])
def test_measured_times_match_known_computing_times(
    rack_name: str, tmp_path: Path, mode: str
) -> None:
    settings = (f"clock.mode={mode}", "board.level.params.process_ms=1.0")
    config = load("fig2", [f"name={rack_name}", *settings])
    assert run_rack(config, 0.8, tmp_path / "run", Display()).outcome.cause == "time over"
    # Use the median, so that a host that takes the machine away does not fail this test.
    found = measure_budgets(Recording(tmp_path / "run"), 50.0)["level"]
    ones = dict.fromkeys(("read_ns", "process_ns", "write_ns", "update_ns"), 1.0)
    expected = {**ones, "plan_ns": 6.0}
    # Each access and each reading of the clock adds some time.
    assert {name: getattr(found, name) / MS for name in expected} == pytest.approx(
        expected, rel=0.08, abs=0.15
    )
