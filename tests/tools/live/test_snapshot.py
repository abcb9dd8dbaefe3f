"""A look at a rack's memory: who is lost, who was restarted, what is demanded, which faults are
active."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.fault_table import Entry, FaultTable, Stage
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.segment import Segment, unlink
from rack.backplane.words import Block, Demand, System
from rack.boards.config import load, wire
from rack.boards.config.faults import injections
from rack.tools.live.snapshot import RackMonitor, TaskRow, joint_names

FAULT = 'fault=[{ kind = "mute", board = "lower" }]'


@pytest.fixture
def segment(small: Path, rack_name: str) -> Iterator[Segment]:
    config = load(small, [f"name={rack_name}", FAULT])
    layout = wire(config)
    made = Segment.create(layout, config.text())
    FaultTable(made).add(injections(config, layout)[0])
    yield made
    made.close()
    unlink(rack_name)


def row(segment: Segment, task: str) -> TaskRow:
    return next(row for row in RackMonitor(segment).look().tasks if row.task == task)


def test_a_task_that_is_lost_says_so_whatever_its_status_says(segment: Segment) -> None:
    segment.block("lower")[Block.LOST] = 41
    assert [row(segment, name).state for name in ("lower", "upper")] == ["lost", "absent"]


def test_restarts_are_the_writers_that_came_after_the_first(segment: Segment) -> None:
    assert row(segment, "lower").restarts == 0
    for _ in range(3):
        open_writer(segment, "lower.status").close()
    assert [row(segment, name).restarts for name in ("lower", "lower.planner", "upper")] == [
        2,
        0,
        0,
    ]


def test_a_fault_is_shown_while_it_is_active(segment: Segment) -> None:
    entry = FaultTable(segment).entries[0]
    seen = []
    for stage in (Stage.WAITING, Stage.ACTIVE, Stage.OVER):
        entry.words[Entry.STAGE] = stage
        seen.append(RackMonitor(segment).look().faults)
    assert seen == [(), ("mute of lower",), ()]


@pytest.mark.parametrize("demand", Demand)
def test_what_is_demanded_of_the_arm_is_shown(segment: Segment, demand: Demand) -> None:
    segment.words[System.DEMAND] = demand
    assert RackMonitor(segment).look().demand == demand.name.lower()


def test_joints_are_those_of_the_config(segment: Segment) -> None:
    assert joint_names(segment.config) == ()
    assert joint_names('[robot]\njoints = ["a", "b"]') == ("a", "b")
