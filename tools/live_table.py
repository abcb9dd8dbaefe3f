"""A snapshot as a table that fits the terminal: one line a task, what holds the rack, and a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rack.tools.holds import is_news
from rack.tools.snapshot import DEAD, LOST, Progress, Snapshot, TaskRow
from rack.tools.text_table import fitting

COLUMNS: dict[str, Callable[[TaskRow], str]] = {
    "slot": lambda row: str(row.slot),
    "task": lambda row: row.task,
    "core": lambda row: str(row.core),
    "sched": lambda row: f"FIFO {row.priority}" if row.priority else "other",
    "Hz": lambda row: f"{row.rate_hz:g}",
    "tick": lambda row: str(row.tick),
    "cycles": lambda row: str(row.cycles),
    "missed": lambda row: str(row.missed),
    "skipped": lambda row: str(row.skipped),
    "restarts": lambda row: str(row.restarts),
    "exec ms": lambda row: _ms(row.exec_ms),
    "late ms": lambda row: _ms(row.lateness_ms),
    "state": lambda row: row.state,
}
"""Columns by heading; `exec` and `late` are the longest since the last look."""
DROPPED = ("tick", "sched", "slot", "cycles", "Hz", "restarts", "core", "exec ms", "late ms", "skipped")
"""Columns that a narrow terminal does without, the first first."""
TEXTS = ("task", "sched", "state")
STATES = {"error": "red", "failed": "red", LOST: "bold red", "done": "green", "holding": "yellow"}
COUNTED = {"missed": "red", "skipped": "red", "restarts": "yellow"}
"""Colours of counts that are not 0."""
HELD = "bold yellow"
NOTHING = "none"
"""The demand on an arm that is free to move."""
PIPE_WIDTH = 120
"""Columns of characters where no terminal says otherwise."""
BAR = 40
"""Columns of characters of the progress bar, at most."""


@dataclass(frozen=True)
class _View:
    """A snapshot that knows its width only when it is drawn."""

    snapshot: Snapshot

    def __rich_console__(self, terminal: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """Yield what rich draws, as wide as the terminal permits."""
        snapshot = self.snapshot
        yield _head(snapshot)
        yield _tasks(snapshot.tasks, options.max_width)
        yield from (Text(line, style="red") for line in _reasons(snapshot))
        yield from (Text(f"fault: {fault}", style="magenta") for fault in snapshot.faults)
        for hold in snapshot.holds:
            lines = (
                [hold.line]
                if len(hold.line) <= options.max_width
                else [hold.parts[0], *map("  {}".format, hold.parts[1:])]
            )
            yield Text("\n".join(lines), style=HELD)
        if snapshot.progress is not None:
            yield _bar(snapshot.progress, options.max_width)


def table_of(snapshot: Snapshot) -> ConsoleRenderable:
    """Return the whole view of a rack: head line, tasks, what they complain of, active faults, holds, progress."""
    return _View(snapshot)


def console() -> Console:
    """Return the console for tables on stdout."""
    found = Console()
    return found if found.is_terminal else Console(width=PIPE_WIDTH)


def line_of(snapshot: Snapshot) -> str:
    """Return the rack as one plain line, for where there is no terminal."""
    missed = sum(row.missed for row in snapshot.tasks)
    skipped = sum(row.skipped for row in snapshot.tasks)
    line = f"{snapshot.rack} {snapshot.time_s:8.2f} s  tick {snapshot.tick}  missed {missed}  skipped {skipped}"
    at = snapshot.progress
    if at is not None:
        line += f"  task {at.state}, action {at.actions_done}/{at.actions}, move {at.moves_done}/{at.moves}"
    lost = [f"{row.task} {LOST}" for row in snapshot.tasks if row.state == LOST]
    holds = [hold.line for hold in snapshot.holds]
    return "  ".join([line, *snapshot.lines, *_demanded(snapshot), *lost, *_reasons(snapshot), *holds])


def _head(snapshot: Snapshot) -> Text:
    line = Text(f"rack {snapshot.rack}: {snapshot.run}, {snapshot.time_s:.2f} s, tick {snapshot.tick}")
    if snapshot.run == DEAD:
        line.append("; its launcher is gone: 'rack clean' removes it", style="bold red")
    if snapshot.clock_skipped:
        line.append(f", clock skipped {snapshot.clock_skipped} ticks", style="yellow")
    for name in [*snapshot.lines, *_demanded(snapshot)]:
        line.append(f"  {name}", style="bold red")
    return line


def _demanded(snapshot: Snapshot) -> list[str]:
    """Return what is demanded of the arm, if anything is."""
    return [f"arm: {snapshot.demand}"] if snapshot.demand != NOTHING else []


def _reasons(snapshot: Snapshot) -> list[str]:
    """Return what tasks complain of; a hold gives its reason itself."""
    held = {hold.level for hold in snapshot.holds}
    rows = [row for row in snapshot.tasks if row.reason and not (row.state == "holding" and row.task in held)]
    told = [hold.why for hold in snapshot.holds]
    return [f"{row.task}: {row.reason}" for row in rows if is_news(row.reason, told)]


def _tasks(rows: tuple[TaskRow, ...], width: int) -> Table:
    head = list(COLUMNS)
    cells = [[cell(row) for cell in COLUMNS.values()] for row in rows]
    kept = fitting(head, cells, width, DROPPED)
    table = Table(box=None, pad_edge=False, header_style="dim")
    for at in kept:
        table.add_column(head[at], justify="left" if head[at] in TEXTS else "right", no_wrap=True)
    for texts in cells:
        table.add_row(*(Text(texts[at], style=_style(head[at], texts[at])) for at in kept))
    return table


def _style(column: str, text: str) -> str:
    if column == "state":
        return STATES.get(text, "")
    return COUNTED.get(column, "") if text != "0" else ""


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _bar(progress: Progress, width: int) -> RenderableType:
    done = f"action {progress.actions_done}/{progress.actions}, move {progress.moves_done}/{progress.moves}"
    left = width - len(f"task  {done} {progress.state}") - 1
    row = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=max(progress.moves, 1), completed=progress.moves_done, width=max(4, min(BAR, left)))
    row.add_row("task", bar, done, progress.state)
    return row


def terminal_width() -> int | None:
    """Return how many columns of characters stdout has; None where it is no terminal."""
    found = Console()
    return found.width if found.is_terminal else None


def print_wrapped(text: str) -> None:
    """Print text, on a terminal with long lines wrapped between words."""
    terminal = console()
    terminal.print(text, highlight=False, markup=False) if terminal.is_terminal else print(text)
