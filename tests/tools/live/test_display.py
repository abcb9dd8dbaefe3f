"""Views of a running rack: the table, and the line for where there is no terminal."""

from __future__ import annotations

from dataclasses import replace

import pytest
from rich.console import Console

from rack.boards.events import Event
from rack.tools.live.display import COLUMNS, PlainDisplay, RackView, line_of
from rack.tools.live.holds import Hold
from rack.tools.live.snapshot import Snapshot, TaskProgress, TaskRow

ROW = TaskRow("servo", 2, 1, 80, 400.0, "executing", 1200, 1201, 0, 3, 4, 1, 0.25, None, "", "", "")
PLANNER = replace(ROW, task="servo.planner", priority=0, missed=0, skipped=0, lateness_ms=1.5)
PROGRESS = TaskProgress(5, 25, 1, 4, "executing", "")
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
    PROGRESS,
    holds=(),
    hosts=(),
    entries=(),
    queues=(),
    inboxes=(),
    exchanges={},
    peers=(),
    imports=(),
    exports=(),
)


MOVE = replace(
    PLANNER, task="elemental_move.planner", exec_ms=1027.97, lateness_ms=1969.67, state="executing"
)
HOLD = Hold(
    "task",
    15268,
    38.17,
    "diverted by the operator (goto home)",
    "rack command a-rack-of-mine task resume",
)


def shown(snapshot: Snapshot, width: int) -> str:
    console = Console(width=width, force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(RackView(snapshot))
    return capture.get()


def test_the_table_has_a_line_for_every_task() -> None:
    lines = shown(SNAPSHOT, 120).splitlines()
    servo = next(line for line in lines if " servo " in line)
    counts = ["1200", "1201", "3", "4", "1"]
    assert servo.split() == [
        "2",
        "servo",
        "1",
        "FIFO",
        "80",
        "400",
        *counts,
        "0.25",
        "-",
        "executing",
    ]
    planner = next(line for line in lines if "servo.planner" in line)
    assert planner.split()[3] == "other"
    assert "action 1/4, move 5/25" in lines[-1]


def test_reasons_and_utility_lines_are_shown() -> None:
    snapshot = replace(
        SNAPSHOT, lines=("EMERGENCY STOP",), tasks=(replace(ROW, reason="joint 'j2': too far"),)
    )
    assert "EMERGENCY STOP" in shown(snapshot, 120)
    assert "servo: joint 'j2': too far" in shown(snapshot, 120)


def test_the_line_counts_over_all_tasks() -> None:
    line = "demo 3.00 s  tick 1200  missed 3  skipped 4  task executing 5/25"
    assert line_of(SNAPSHOT) == line


def test_the_line_is_short_whatever_holds_the_rack() -> None:
    troubled = replace(
        SNAPSHOT,
        holds=(HOLD, HOLD),
        faults=("mute of servo (servo.status)",),
        tasks=(replace(ROW, reason="joint 'j2': too far"),),
        lines=("NO REAL-TIME PRIORITY: servo, servo.planner",),
        progress=None,
    )
    ends = "missed 3  skipped 4  holds 2  faults 1  NO REAL-TIME PRIORITY"
    assert line_of(troubled).endswith(ends)
    assert len(line_of(troubled)) <= 90


def test_faults_demands_and_lost_boards_are_shown() -> None:
    lost = replace(PLANNER, state="lost")
    snapshot = replace(
        SNAPSHOT, demand="brake", faults=("mute of servo (servo.status)",), tasks=(ROW, lost)
    )
    lines = shown(snapshot, 120).splitlines()
    assert lines[0].endswith("arm: brake")
    assert next(line for line in lines if "servo.planner" in line).split()[-1] == "lost"
    assert "fault: mute of servo (servo.status)" in lines
    assert line_of(snapshot).endswith("lost 1  faults 1  task executing 5/25  arm: brake")


def test_an_arm_that_is_free_to_move_is_not_spoken_of() -> None:
    assert "arm:" not in shown(SNAPSHOT, 120) + line_of(SNAPSHOT)


def test_a_display_tells_the_course_of_a_fault_and_leaves_misses_to_the_table(
    capsys: pytest.CaptureFixture[str],
) -> None:
    display = PlainDisplay()
    display.show_event(Event(0, 7, "fault", "servo", "kill begins", "begins", 0))
    display.show_event(Event(0, 8, "miss", "clock", "'servo' has not finished", "late"))
    display.show_event(Event(0, -1, "printed", "", "hello"))
    assert capsys.readouterr().out == "tick 7 fault: servo: kill begins\nprinted: hello\n"


@pytest.mark.parametrize("width", [60, 80, 100, 120, 200])
def test_the_table_has_as_many_columns_as_fit_and_cuts_none(width: int) -> None:
    lines = shown(replace(SNAPSHOT, tasks=(ROW, PLANNER, MOVE)), width).splitlines()
    assert max(map(len, lines)) <= width
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(lines)
    head = next(line for line in lines if "task " in line and "state" in line)
    assert {"task", "missed", "state"} <= set(head.split())
    assert next(line for line in lines if MOVE.task in line).split()[-1] == "executing"
    assert lines[-1].endswith("action 1/4, move 5/25 executing")
    if width >= 120:
        assert head.split() == " ".join(COLUMNS).split()


def test_what_holds_the_rack_is_shown_with_a_command_that_is_not_torn() -> None:
    snapshot = replace(SNAPSHOT, holds=(HOLD,))
    narrow, wide = shown(snapshot, 80).splitlines(), shown(snapshot, 160).splitlines()
    assert "  to release: rack command a-rack-of-mine task resume" in (
        line.rstrip() for line in narrow
    )
    assert HOLD.line in (line.rstrip() for line in wide)


def test_a_reason_that_a_hold_gives_is_not_given_twice() -> None:
    row = replace(ROW, task="task", state="holding", reason="held by the operator")
    assert shown(replace(SNAPSHOT, tasks=(row,), holds=(HOLD,)), 160).count("by the operator") == 1
    assert "task: held by the operator" in shown(replace(SNAPSHOT, tasks=(row,)), 160)
