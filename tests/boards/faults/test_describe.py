"""Faults as text and as plain data."""

from __future__ import annotations

import pytest

from rack.backplane.fault_table import NEVER, FaultTable, Injection, Stage
from rack.boards.faults.describe import (
    ALL_JOINTS,
    describe_fault,
    find_board,
    find_subject,
    to_document,
)
from rack.boards.faults.kind import KINDS
from tests.backplane.bus import NAME, mailbox, task
from tests.backplane.conftest import MakeBus

JOINTS = ("j1", "j2")


@pytest.fixture
def table(make_bus: MakeBus) -> FaultTable:
    return FaultTable(make_bus(task("writer"), task("reader"), mailbox()))


def injection(
    kind: str, task: int = 0, mailbox: int = -1, parameters: tuple[float, ...] = ()
) -> Injection:
    """Return a fault of the writer, if nothing else is said."""
    return Injection(KINDS[kind].number, task, mailbox, parameters=parameters)


@pytest.mark.parametrize(
    ("fault", "board", "subject", "text"),
    [
        (injection("kill"), "writer", "", "kill of writer"),
        (injection("kill", 1), "reader", "", "kill of reader"),
        (injection("clock-skip", -1, parameters=(3.0,)), "clock", "", None),
        (injection("mute", mailbox=0), "writer", NAME, f"mute of writer ({NAME})"),
        (injection("drop", mailbox=0, parameters=(0.25,)), "writer", NAME, None),
        (injection("sensor-nan", parameters=(1.0,)), "writer", "j2", "sensor-nan of writer (j2)"),
        (injection("sensor-nan", parameters=(-1.0,)), "writer", ALL_JOINTS, None),
        (injection("sensor-nan", parameters=(2.0,)), "writer", "joint 2", None),
    ],
)
def test_a_fault_is_a_line_with_its_target(
    table: FaultTable, fault: Injection, board: str, subject: str, text: str | None
) -> None:
    entry = table.add_fault(fault)
    layout = table._segment.layout
    assert find_board(entry, layout) == board
    assert find_subject(entry, layout, JOINTS) == subject
    line = describe_fault(entry, layout, JOINTS)
    assert line.startswith(f"{KINDS[fault.kind].name} of {board}")
    assert subject in line
    assert text in (None, line)
    assert describe_fault(entry, layout, JOINTS, with_board=False) == line.replace(
        f" of {board}", ""
    )


def test_parameters_have_their_units_and_ratios_none(table: FaultTable) -> None:
    layout = table._segment.layout
    drop = table.add_fault(injection("drop", mailbox=0, parameters=(0.25,)))
    assert describe_fault(drop, layout, JOINTS) == f"drop of writer ({NAME}, probability 0.25)"
    overrun = table.add_fault(injection("overrun", parameters=(1.5, 0.0)))
    assert describe_fault(overrun, layout, JOINTS) == "overrun of writer (by 1.5 cycles, random 0)"


def test_a_document_contains_the_ticks_known_at_its_stage(table: FaultTable) -> None:
    entry = table.add_fault(Injection(KINDS["mute"].number, 0, 0, tick=40, ticks=8))
    layout = table._segment.layout
    entry.until = 48
    waiting = to_document(entry, layout, JOINTS)
    assert (waiting["stage"], waiting["begins"], waiting["until"]) == ("waiting", 40, None)
    assert (waiting["struck_tick"], waiting["acted"], waiting["ticks"]) == (-1, 0, 8)
    assert (waiting["kind"], waiting["board"], waiting["mailbox"]) == ("mute", "writer", NAME)
    for stage in (Stage.ACTIVE, Stage.OVER):
        entry.stage = stage
        assert to_document(entry, layout, JOINTS)["until"] == 48
    entry.until = NEVER
    assert to_document(entry, layout, JOINTS)["until"] is None
