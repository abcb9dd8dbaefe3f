"""A rack on the terminal: a live table while it runs; a line a second where there is no terminal;
nothing with --json.

The table has a line a task; below it are the active faults, what holds the rack, and the progress
of its task.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rack.backplane.process import DEADLINE
from rack.boards.events import NO_TORQUE, Event
from rack.boards.exchange import PortAge
from rack.tools.console.tables import console, decimal, grid
from rack.tools.live.holds import is_news
from rack.tools.live.host_side import EntryRow, HostRow
from rack.tools.live.network import ExportRow, ImportRow, PeerRow
from rack.tools.live.snapshot import DEAD, LOST, Snapshot, TaskProgress, TaskRow

if TYPE_CHECKING:
    from rich.live import Live


def _scheduling(priority: int) -> str:
    if priority == DEADLINE:
        return "deadline"
    return f"FIFO {priority}" if priority else "other"


COLUMNS: dict[str, Callable[[TaskRow], str]] = {
    "slot": lambda row: str(row.slot),
    "task": lambda row: row.task,
    "core": lambda row: str(row.core),
    "sched": lambda row: _scheduling(row.priority),
    "Hz": lambda row: f"{row.rate_hz:g}",
    "tick": lambda row: str(row.tick),
    "cycles": lambda row: str(row.cycles),
    "missed": lambda row: str(row.missed),
    "skipped": lambda row: str(row.skipped),
    "restarts": lambda row: str(row.restarts),
    "exec ms": lambda row: decimal(row.exec_ms, 2),
    "late ms": lambda row: decimal(row.lateness_ms, 2),
    "state": lambda row: row.state + " (operator)" * (row.mode == "operator"),
}
"""Columns by heading; `exec` and `late` are the longest since the last look."""
DROPPED = (
    "tick",
    "sched",
    "slot",
    "cycles",
    "Hz",
    "restarts",
    "core",
    "exec ms",
    "late ms",
    "skipped",
)
"""Columns that a narrow terminal leaves out, in this order."""
STATES = {
    "error": "red",
    "failed": "red",
    LOST: "bold red",
    "done": "green",
    "holding": "yellow",
    "awaited": "yellow",
}
COUNTED = {
    **dict.fromkeys(("missed", "skipped"), "red"),
    **dict.fromkeys(
        ("restarts", "refused", "full", "missing", "late", "unknown_launch", "losses"), "yellow"
    ),
}
"""Colours of counts above 0."""
HELD = "bold yellow"
NO_DEMAND = "none"
"""The demand on an arm that is free to move."""
BAR = 40
"""Longest progress bar, in characters."""
EVENTS = {"fault": "magenta", "detection": "yellow", "reaction": "red", "recovery": "green"}
OTHER_EVENTS = "yellow"
QUIET = ("launch", "start", "end", "miss")
"""Events that the display shows already: the table counts the misses."""
BRIEF_TICKS = 10
"""Brakes that missed cycles engaged for fewer ticks than this are counted, not shown."""


class Display:
    """Shows a run; this one shows nothing, for --json. `period_s` is the time between looks."""

    period_s = 0.5

    def show(self, snapshot: Snapshot) -> None:
        """Show the rack as it is now."""

    def show_event(self, event: Event) -> None:
        """Show an event."""


class LiveDisplay(Display):
    """A table that changes in place."""

    period_s = 0.2

    def __init__(self, live: Live) -> None:
        self._live = live

    def show(self, snapshot: Snapshot) -> None:
        """Redraw the table."""
        self._live.update(RackView(snapshot), refresh=True)

    def show_event(self, event: Event) -> None:
        """Print the event above the table."""
        if is_shown(event):
            style = EVENTS.get(event.kind, OTHER_EVENTS)
            # The terminal wraps it, not rich: a command in it can still be copied.
            self._live.console.print(
                event_line(event), style=style, highlight=False, markup=False, soft_wrap=True
            )


class PlainDisplay(Display):
    """A line a second."""

    period_s = 1.0

    def __init__(self) -> None:
        self._next = 0.0

    def show(self, snapshot: Snapshot) -> None:
        """Print the rack as one line, once a second and at the end."""
        now = time.monotonic()
        if now >= self._next or snapshot.run == "stopped":
            self._next = now + self.period_s
            print(line_of(snapshot), flush=True)

    def show_event(self, event: Event) -> None:
        """Print the event."""
        if is_shown(event):
            print(event_line(event), flush=True)


@contextmanager
def display_for(silent: bool) -> Iterator[Display]:
    """Give the display that suits stdout."""
    terminal = console()
    if silent:
        yield Display()
    elif terminal.is_terminal:
        from rich.live import Live

        with Live(console=terminal, auto_refresh=False) as live:
            yield LiveDisplay(live)
    else:
        yield PlainDisplay()


@dataclass(frozen=True)
class RackView:
    """A snapshot, for rich to draw: head line, tasks, rows of tables, complaints, queues, faults,
    holds, progress. A narrow terminal leaves out the columns `dropped`, in that order."""

    snapshot: Snapshot
    columns: Mapping[str, Callable[[TaskRow], str]] = field(default_factory=lambda: COLUMNS)
    dropped: Sequence[str] = DROPPED

    def __rich_console__(
        self, terminal: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Yield what rich draws, as wide as the terminal permits."""
        snapshot = self.snapshot
        width = options.max_width
        yield _head(snapshot)
        cells = [[cell(row) for cell in self.columns.values()] for row in snapshot.tasks]
        yield grid(list(self.columns), cells, width, self.dropped, _style)
        yield from (Text(f"{row.task}: {row.row}") for row in snapshot.tasks if row.row)
        for rows in (
            snapshot.hosts,
            snapshot.entries,
            snapshot.peers,
            snapshot.imports,
            snapshot.exports,
        ):
            yield from _rows(rows, width)
        yield from (Text(line, style="red") for line in _reasons(snapshot))
        yield from (Text(queue.line) for queue in snapshot.queues)
        yield from (Text(inbox.line) for inbox in snapshot.inboxes)
        yield from (Text(_exchange(board, ports)) for board, ports in snapshot.exchanges.items())
        yield from (Text(f"fault: {fault}", style="magenta") for fault in snapshot.faults)
        for hold in snapshot.holds:
            shown = hold.line
            if len(shown) > width:
                shown = "\n  ".join(hold.parts)
            yield Text(shown, style=HELD)
        if snapshot.progress is not None:
            bar_width = width if terminal.is_terminal else 0
            yield _bar(snapshot.progress, bar_width)


def _rows(
    rows: Sequence[HostRow | EntryRow | PeerRow | ImportRow | ExportRow], width: int
) -> Iterator[RenderableType]:
    """Yield the table of host boards, other racks, or what passes to and from them, if there are
    any."""
    if rows:
        found = [asdict(row) for row in rows]
        cells = [[_cell(name, value) for name, value in row.items()] for row in found]
        yield Text()
        yield grid([name.replace("_", " ") for name in found[0]], cells, width, style=_style)


def _cell(column: str, value: Any) -> str:
    if not isinstance(value, float | None):
        return str(value)
    if column.endswith("_ticks"):
        return decimal(value, 0)
    if column.endswith("_s"):
        return decimal(value, 3)
    return decimal(value, 1)


def line_of(snapshot: Snapshot) -> str:
    """Return the rack as one short line, for where there is no terminal: what holds it and its
    faults are counted."""
    counts = {
        "missed": sum(row.missed for row in snapshot.tasks),
        "skipped": sum(row.skipped for row in snapshot.tasks),
        "lost": sum(row.state == LOST for row in snapshot.tasks),
        "holds": len(snapshot.holds),
        "faults": len(snapshot.faults),
    }
    parts = [f"{snapshot.rack} {snapshot.time_s:.2f} s", f"tick {snapshot.tick}"]
    parts += [snapshot.run] if snapshot.run == DEAD else []
    parts += [f"{name} {n}" for name, n in counts.items() if n or name in ("missed", "skipped")]
    at = snapshot.progress
    parts += [f"task {at.state} {at.moves_done}/{at.moves}"] if at is not None else []
    # What follows a colon is in the table.
    return "  ".join(
        [*parts, *(line.partition(":")[0] for line in snapshot.lines), *_demanded(snapshot)]
    )


def _head(snapshot: Snapshot) -> Text:
    line = Text(
        f"rack {snapshot.rack}: {snapshot.run}, {snapshot.time_s:.2f} s, tick {snapshot.tick}"
    )
    if snapshot.run == DEAD:
        line.append("; its launcher is gone: 'rack clean' removes it", style="bold red")
    if snapshot.clock_skipped:
        line.append(f", clock skipped {snapshot.clock_skipped} ticks", style="yellow")
    for name in [*snapshot.lines, *_demanded(snapshot)]:
        line.append(f"  {name}", style="bold red")
    return line


def _demanded(snapshot: Snapshot) -> list[str]:
    """Return the demand on the arm, if there is one."""
    return [f"arm: {snapshot.demand}"] if snapshot.demand != NO_DEMAND else []


def _reasons(snapshot: Snapshot) -> list[str]:
    """Return the reasons that tasks give, except those that a hold already shows."""
    held = {hold.level for hold in snapshot.holds}
    rows = [
        row
        for row in snapshot.tasks
        if row.reason and not (row.state == "holding" and row.task in held)
    ]
    shown = [hold.why for hold in snapshot.holds]
    return [f"{row.task}: {row.reason}" for row in rows if is_news(row.reason, shown)]


def _exchange(board: str, ports: Mapping[str, PortAge]) -> str:
    """Return the ages of a board's messages, as one line."""
    shown = [
        f"{port} {found.age} ticks old, taken at tick {found.taken}"
        for port, found in ports.items()
    ]
    return f"exchange of {board}: {'; '.join(shown) or 'no message yet'}"


def _style(column: str, text: str) -> str:
    if column == "state":
        return STATES.get(text.partition(" (")[0], "")
    return COUNTED.get(column, "") if text != "0" else ""


def _bar(progress: TaskProgress, width: int) -> RenderableType:
    """Return the progress as a bar and text; without a width, as text alone."""
    done = (
        f"action {progress.actions_done}/{progress.actions}, move"
        f" {progress.moves_done}/{progress.moves}"
    )
    left = width - len(f"task  {done} {progress.state}") - 1
    bar = ProgressBar(
        total=max(progress.moves, 1), completed=progress.moves_done, width=max(4, min(BAR, left))
    )
    row = Table.grid(padding=(0, 1))
    row.add_row("task", *([bar] if width else []), done, progress.state)
    return row


def is_shown(event: Event) -> bool:
    """Return whether an event is more than the table shows."""
    is_brief = event.subject == NO_TORQUE and event.value < BRIEF_TICKS
    return event.kind not in QUIET and not is_brief


def event_line(event: Event) -> str:
    """Return an event as one line."""
    tick = f"tick {event.tick} " if event.code else ""
    board = f"{event.board}: " if event.board else ""
    return f"{tick}{event.kind}: {board}{event.text}"
