"""Views of a running rack: the table, and the line for where there is no terminal."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console

from tools.live_table import line_of, table_of
from tools.snapshot import Progress, Snapshot, TaskRow

ROW = TaskRow("servo", 2, 1, 80, 400.0, "executing", 1200, 1201, 0, 3, 4, 0.25, None, "")
PLANNER = replace(ROW, task="servo.planner", priority=0, missed=0, skipped=0, lateness_ms=1.5)
SNAPSHOT = Snapshot("demo", "running", 1200, 3.0, 0, (), (ROW, PLANNER), Progress(5, 25, 1, 4, "executing", ""))


def shown(snapshot: Snapshot, width: int) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table_of(snapshot))
    return capture.get()


def test_the_table_has_a_line_for_every_task() -> None:
    lines = shown(SNAPSHOT, 110).splitlines()
    servo = next(line for line in lines if " servo " in line)
    assert servo.split() == ["2", "servo", "1", "FIFO", "80", "400", "1200", "1201", "3", "4", "0.25", "-", "executing"]
    planner = next(line for line in lines if "servo.planner" in line)
    assert planner.split()[3] == "other"
    assert "action 1/4, move 5/25" in lines[-1]


def test_reasons_and_utility_lines_are_shown() -> None:
    snapshot = replace(SNAPSHOT, lines=("EMERGENCY STOP",), tasks=(replace(ROW, reason="joint 'j2': too far"),))
    assert "EMERGENCY STOP" in shown(snapshot, 110)
    assert "servo: joint 'j2': too far" in shown(snapshot, 110)
    assert line_of(snapshot).endswith("EMERGENCY STOP  servo: joint 'j2': too far")


def test_the_line_counts_over_all_tasks() -> None:
    assert "3.00 s  tick 1200  missed 3  skipped 4  task executing, action 1/4, move 5/25" in line_of(SNAPSHOT)
