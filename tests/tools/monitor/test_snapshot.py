"""Tests snapshots of a rack's memory: lost and restarted boards, demands, active faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.fault_table import FaultTable, Stage
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Demand, System, TaskState
from rack.boards.config import load
from rack.boards.config.injections import build_injections
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.monitor.snapshot import RackMonitor, Snapshot, TaskRow
from rack.tools.report.report import write_report
from tests.tools.conftest import MakeSegment

FAULT = 'fault=[{ kind = "mute", board = "lower" }]'


@pytest.fixture
def segment(small: Path, rack_name: str, make_segment: MakeSegment) -> Segment:
    config = load(small, [f"name={rack_name}", FAULT])
    made = make_segment(config)
    FaultTable(made).add_fault(build_injections(config, made.layout)[0])
    return made


class Seen(Display):
    """Stores the states in which `upper` was shown."""

    period_s = 0.01

    def __init__(self) -> None:
        self.states: set[str] = set()

    def show(self, snapshot: Snapshot) -> None:
        """Keep the state."""
        self.states |= {row.state for row in snapshot.tasks if row.task == "upper"}


def row(segment: Segment, task: str) -> TaskRow:
    return next(row for row in RackMonitor(segment).take_snapshot().tasks if row.task == task)


def test_a_lost_task_is_shown_as_lost_whatever_its_status(segment: Segment) -> None:
    segment.get_block("lower")[Block.LOST] = 41
    assert [row(segment, name).state for name in ("lower", "upper")] == ["lost", "absent"]


@pytest.mark.parametrize(("number", "shown"), [(State.HOLDING, "holding"), (9, "absent")])
def test_an_unknown_state_number_shows_the_state_of_the_process(
    segment: Segment, number: int, shown: str
) -> None:
    writer = open_writer(segment, "upper.status")
    writer.message.state = number
    writer.write(0)
    writer.close()
    assert row(segment, "upper").state == shown


@pytest.mark.slow
@pytest.mark.parametrize(("level", "own"), [("Stateless", set()), ("Reasonless", {"holding"})])
def test_a_level_without_state_or_reason_in_its_status_runs_normally(
    small: Path, rack_name: str, tmp_path: Path, level: str, own: set[str]
) -> None:
    settings = ["board.upper.ends_run=false", f"board.upper.executor=two_levels:{level}"]
    display = Seen()
    config = load(small, [f"name={rack_name}", *settings])
    assert run_rack(config, 2.0, tmp_path / "run", display).worked
    assert display.states
    assert display.states <= own | {state.name.lower() for state in TaskState}
    write_report(tmp_path / "run")


def test_restarts_count_the_writers_after_the_first(segment: Segment) -> None:
    assert row(segment, "lower").restarts == 0
    for _ in range(3):
        open_writer(segment, "lower.status").close()
    names = ("lower", "lower.planner", "upper")
    assert [row(segment, name).restarts for name in names] == [2, 0, 0]


def test_active_faults_and_the_demand_on_the_arm_are_shown(segment: Segment) -> None:
    entry = FaultTable(segment).entries[0]
    seen = []
    for stage in (Stage.WAITING, Stage.ACTIVE, Stage.OVER):
        entry.stage = stage
        seen.append(RackMonitor(segment).take_snapshot().faults)
    assert seen == [(), ("mute of lower",), ()]
    for demand in Demand:
        segment.words[System.DEMAND] = demand
        assert RackMonitor(segment).take_snapshot().demand == demand.name.lower()
