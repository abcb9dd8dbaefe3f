"""A snapshot as a table: one line a board, and a progress bar of the task."""

from __future__ import annotations

from rich.console import Console, Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from tools.snapshot import LOST, Progress, Snapshot, TaskRow

COLUMNS = (
    *("slot", "task", "core", "sched", "Hz", "tick", "cycles", "missed", "skipped", "restarts"),
    *("exec ms", "late ms", "state"),
)
"""Headings; `exec` and `late` are the longest since the last look."""
TEXTS = ("task", "sched", "state")
STATES = {"error": "red", "failed": "red", LOST: "bold red", "done": "green"}
NOTHING = "none"
"""The demand on an arm that is free to move."""
NARROWEST = 120
"""Columns of characters that the table takes where no terminal says otherwise."""


def table_of(snapshot: Snapshot) -> RenderableType:
    """Return the whole view of a rack: head line, boards, what they complain of, active faults, progress."""
    reasons = [Text(f"{row.task}: {row.reason}", style="red") for row in snapshot.tasks if row.reason]
    faults = [Text(f"fault: {fault}", style="magenta") for fault in snapshot.faults]
    parts: list[RenderableType] = [_head(snapshot), _boards(snapshot.tasks), *reasons, *faults]
    if snapshot.progress is not None:
        parts.append(_bar(snapshot.progress))
    return Group(*parts)


def console() -> Console:
    """Return the console for tables on stdout."""
    found = Console()
    return found if found.is_terminal else Console(width=NARROWEST)


def line_of(snapshot: Snapshot) -> str:
    """Return the rack as one plain line, for where there is no terminal."""
    missed = sum(row.missed for row in snapshot.tasks)
    skipped = sum(row.skipped for row in snapshot.tasks)
    line = f"{snapshot.rack} {snapshot.time_s:8.2f} s  tick {snapshot.tick}  missed {missed}  skipped {skipped}"
    at = snapshot.progress
    if at is not None:
        line += f"  task {at.state}, action {at.actions_done}/{at.actions}, move {at.moves_done}/{at.moves}"
    lost = [f"{row.task} {LOST}" for row in snapshot.tasks if row.state == LOST]
    reasons = [f"{row.task}: {row.reason}" for row in snapshot.tasks if row.reason]
    return "  ".join([line, *snapshot.lines, *_demanded(snapshot), *lost, *reasons])


def _head(snapshot: Snapshot) -> Text:
    line = Text(f"rack {snapshot.rack}: {snapshot.run}, {snapshot.time_s:.2f} s, tick {snapshot.tick}")
    if snapshot.clock_skipped:
        line.append(f", clock left out {snapshot.clock_skipped}", style="yellow")
    for name in [*snapshot.lines, *_demanded(snapshot)]:
        line.append(f"  {name}", style="bold red")
    return line


def _demanded(snapshot: Snapshot) -> list[str]:
    """Return what is demanded of the arm, if anything is."""
    return [f"arm: {snapshot.demand}"] if snapshot.demand != NOTHING else []


def _boards(rows: tuple[TaskRow, ...]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name in TEXTS else "right", no_wrap=True)
    for row in rows:
        table.add_row(*_cells(row))
    return table


def _cells(row: TaskRow) -> list[str | Text]:
    return [
        str(row.slot),
        row.task,
        str(row.core),
        f"FIFO {row.priority}" if row.priority else "other",
        f"{row.rate_hz:g}",
        str(row.tick),
        str(row.cycles),
        Text(str(row.missed), style="red" if row.missed else ""),
        Text(str(row.skipped), style="red" if row.skipped else ""),
        Text(str(row.restarts), style="yellow" if row.restarts else ""),
        _ms(row.exec_ms),
        _ms(row.lateness_ms),
        Text(row.state, style=STATES.get(row.state, "")),
    ]


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _bar(progress: Progress) -> RenderableType:
    row = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=max(progress.moves, 1), completed=progress.moves_done, width=40)
    done = f"action {progress.actions_done}/{progress.actions}, move {progress.moves_done}/{progress.moves}"
    row.add_row("task", bar, done, progress.state)
    return row
