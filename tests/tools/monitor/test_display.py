"""Tests the views of a running rack: the table, and the line without a terminal."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from rack.boards.events import Event
from rack.tools.monitor.display import COLUMNS, PlainDisplay, RackView, format_line
from rack.tools.monitor.holds import Hold
from rack.tools.monitor.snapshot import Snapshot, TaskProgress, TaskRow

ROW = TaskRow(
    "servo",
    2,
    1,
    80,
    400.0,
    "executing",
    1200,
    1201,
    0,
    3,
    4,
    1,
    0.25,
    None,
    "",
    "",
    "",
    "fixed-priority",
)
PLANNER = replace(ROW, task="servo.planner", priority=0, missed=0, skipped=0, lateness_ms=1.5)
MOVE = replace(PLANNER, task="elemental_move.planner", exec_ms=1027.97, lateness_ms=1969.67)
TROUBLED = replace(ROW, reason="joint 'j2': too far")
OPERATED = replace(ROW, task="task", state="holding", reason="held by the operator")
HOLD = Hold(
    "task", 15268, 38.17, "diverted by the operator (goto)", "rack command a task resume", "task"
)
MUTE = "mute of servo (servo.status)"
SNAPSHOT = Snapshot(
    "demo",
    "running",
    1200,
    3.0,
    0,
    (),
    "none",
    (),
    (ROW, PLANNER),
    TaskProgress(5, 25, 1, 4, "executing", ""),
    exchanges={},
    **dict.fromkeys(  # type: ignore[arg-type]
        ("holds", "hosts", "entries", "queues", "inboxes", "peers", "imports", "exports"), ()
    ),
)


def shown(view: Snapshot | RackView, width: int = 120) -> list[str]:
    """Return the lines of the table."""
    console = Console(width=width, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(RackView(view) if isinstance(view, Snapshot) else view)
    return [line.rstrip() for line in capture.get().splitlines()]


def test_the_table_has_a_line_for_every_task() -> None:
    lines = shown(SNAPSHOT)
    words = {line.split()[1]: line.split() for line in lines if line.split()[0] == "2"}
    counts = ["400", "1200", "1201", "3", "4", "1", "0.25", "-", "executing"]
    assert words["servo"] == ["2", "servo", "1", "FIFO", "80", *counts]
    assert words["servo.planner"][3] == "other"
    assert lines[-1] == "task: action 1/4, move 5/25 executing"
    assert "arm:" not in "".join(lines)


HEAD = "rack demo: running, 3.00 s, tick 1200"
LOST = replace(PLANNER, state="lost")
NO_PRIORITY = "NO REAL-TIME PRIORITY: servo, servo.planner"
SHOWN: list[tuple[dict[str, Any], list[str], str]] = [
    ({}, [], "demo 3.00 s  tick 1200  missed 3  skipped 4  task executing 5/25"),
    (
        {"lines": ("EMERGENCY STOP",), "tasks": (TROUBLED,)},
        [f"{HEAD}  EMERGENCY STOP"],
        "task executing 5/25  EMERGENCY STOP",
    ),
    (
        {"demand": "brake", "faults": (MUTE,), "tasks": (ROW, LOST)},
        [f"{HEAD}  arm: brake", f"fault: {MUTE}"],
        "lost 1  faults 1  task executing 5/25  arm: brake",
    ),
    (
        {"run": "dead", "clock_skipped": 7},
        [
            f"{HEAD.replace('running', 'dead')}; its launcher is gone: 'rack clean' removes it,"
            " clock skipped 7 ticks"
        ],
        "demo 3.00 s  tick 1200  dead  missed 3  skipped 4  task executing 5/25",
    ),
    (
        {"holds": (HOLD, HOLD), "faults": (MUTE,), "lines": (NO_PRIORITY,), "progress": None},
        [HOLD.line],
        "missed 3  skipped 4  holds 2  faults 1  NO REAL-TIME PRIORITY",
    ),
    ({"holds": (HOLD,), "tasks": (OPERATED,)}, [], "holds 1  task executing 5/25"),
    ({"tasks": (OPERATED,)}, [], ""),
]


@pytest.mark.parametrize(("changes", "lines", "end"), SHOWN)
def test_table_and_line_show_holds_and_problems_of_the_rack(
    changes: dict[str, Any], lines: list[str], end: str
) -> None:
    snapshot = replace(SNAPSHOT, **changes)
    found = shown(snapshot)
    assert [line for line in lines if line not in found] == []
    assert sum("by the operator" in line for line in found) == len(
        snapshot.holds or [row for row in snapshot.tasks if row.reason.startswith("held")]
    )
    assert format_line(snapshot).endswith(end)
    # It is short whatever holds the rack.
    assert not snapshot.holds or len(format_line(snapshot)) <= 90


WAITING = replace(PLANNER, task="upper", reason="waiting for servo: joint 'j2': too far")
BRAKED = replace(HOLD, level="arm", why="braked: emergency stop", release="", task="servo")


@pytest.mark.parametrize(
    ("changes", "reasons", "below"),
    [
        # A relayed reason is shortened.
        (
            {"tasks": (TROUBLED, WAITING)},
            {"servo": "joint 'j2': too far", "upper": "waiting for servo"},
            [],
        ),
        # A reason that a hold gives is not given twice, and a command is never wrapped.
        (
            {"tasks": (ROW, OPERATED), "holds": (HOLD,)},
            {"task": "diverted by the operator (goto), since 38.17 s"},
            ["to release task: rack command a task resume"],
        ),
        ({"holds": (BRAKED,)}, {"servo": "braked: emergency stop, since 38.17 s"}, []),
        ({"tasks": (ROW,), "holds": (HOLD,)}, {}, [HOLD.line]),
    ],
)
def test_a_reason_stands_in_the_row_of_its_task(
    changes: dict[str, Any], reasons: dict[str, str], below: list[str]
) -> None:
    for width in (160, 40):
        lines = shown(replace(SNAPSHOT, **changes), width)
        assert max(map(len, lines)) <= width
        printed = " ".join(" ".join(lines).split())
        for task, reason in reasons.items():
            if width > 100:
                (line,) = (line for line in lines if line.endswith(f"  {reason}"))
                assert line.split()[1] == task
            else:
                # It would leave no space for the table.
                assert f"{task}: {reason}" in printed
        assert all(line in (lines if width > 100 else printed) for line in below)


def test_a_sparkline_is_left_out_where_counts_need_its_space() -> None:
    view = RackView(SNAPSHOT, {ROW.task: "▁▂▃", PLANNER.task: "▇"})
    for width, is_shown in ((160, True), (80, False)):
        assert ("▁▂▃" in "".join(shown(view, width))) == is_shown


def test_a_display_shows_the_events_of_a_fault_but_no_misses(
    capsys: pytest.CaptureFixture[str],
) -> None:
    display = PlainDisplay(sys.stdout)
    display.show_event(Event(0, 7, "fault", "servo", "kill begins", "begins", 0))
    display.show_event(Event(0, 8, "miss", "clock", "'servo' has not finished", "late"))
    display.show_event(Event(0, -1, "printed", "", "hello"))
    assert capsys.readouterr().out == "tick 7 fault: servo: kill begins\nprinted: hello\n"


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_table_has_as_many_columns_as_fit_and_cuts_none(width: int) -> None:
    lines = shown(replace(SNAPSHOT, tasks=(ROW, PLANNER, MOVE)), width)
    assert max(map(len, lines)) <= width
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(lines)
    head = next(line for line in lines if "task " in line and "state" in line)
    assert {"task", "missed", "state"} <= set(head.split())
    assert next(line for line in lines if MOVE.task in line).split()[-1] == "executing"
    if width >= 120:
        assert head.split() == " ".join(COLUMNS).split()
