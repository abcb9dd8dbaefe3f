"""Shows a rack on the terminal while it runs.

On a terminal it is a live table with a line for each task. Below the table are active faults, holds
and the progress of the task. Elsewhere one line a second is printed, and nothing with --json.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console, ConsoleOptions, RenderableType
from rich.text import Text

from rack.boards.events import NO_TORQUE, Event
from rack.boards.exchange import PortAge
from rack.tools.console.answer import print_text
from rack.tools.console.tables import build_grid, create_console, format_decimal
from rack.tools.monitor.holds import is_new_reason
from rack.tools.monitor.snapshot import DEAD, LOST, Snapshot, TaskRow

if TYPE_CHECKING:
    from rich.live import Live

SCHEDULING = {"earliest-deadline-first": "deadline", "maximum-urgency-first": "urgency"}

COLUMNS: dict[str, Callable[[TaskRow], Any]] = {
    **{name: attrgetter(name) for name in ("slot", "task", "core")},
    "sched": lambda row: SCHEDULING.get(
        row.scheduler, f"FIFO {row.priority}" if row.priority else "other"
    ),
    "Hz": lambda row: f"{row.rate_hz:g}",
    **{name: attrgetter(name) for name in ("tick", "cycles", "missed", "skipped", "restarts")},
    "exec ms": lambda row: format_decimal(row.exec_ms, 2),
    "late ms": lambda row: format_decimal(row.lateness_ms, 2),
    "state": lambda row: row.state + " (operator)" * (row.mode == "operator"),
}
"""Functions that format the cells of each column, keyed by its heading."""
DROPPED = (
    "tick",
    "sched",
    "slot",
    "cycles",
    "Hz",
    "lateness",
    "restarts",
    "core",
    "exec ms",
    "late ms",
    "skipped",
)
"""Columns that a narrow terminal leaves out, in this order."""
STATE_STYLES = {
    "error": "red",
    "failed": "red",
    LOST: "bold red",
    "done": "green",
    "holding": "yellow",
    "awaited": "yellow",
}
LOSSES = ("missed", "skipped")
TROUBLES = ("restarts", "refused", "full", "missing", "late", "unknown_launch", "losses")
HOLD_STYLE = "bold yellow"
COUNT_STYLES = {
    **dict.fromkeys(LOSSES, "red"),
    **dict.fromkeys(TROUBLES, "yellow"),
    "why": HOLD_STYLE,
}
"""Colours of counts above 0, and of reasons."""
WHY_LEAST_WIDTH = 75
"""Width of a terminal up to which reasons stand below the table."""
NO_DEMAND = "none"
"""Safety demand on an arm that is free to move."""
EVENT_STYLES = {"fault": "magenta", "detection": "yellow", "reaction": "red", "recovery": "green"}
DEFAULT_EVENT_STYLE = "yellow"
HIDDEN_EVENTS = ("launch", "start", "end", "miss")
"""Kinds of events that the table shows already: for example, it counts misses."""
BRIEF_TICKS = 10
"""Braking because of missed cycles for fewer ticks than this is counted, but not shown."""


class Display:
    """Shows a run. This base class shows nothing, for --json.

    Attributes:
        period_s: Time between two snapshots.
    """

    period_s = 0.5

    def show(self, snapshot: Snapshot) -> None:
        """Show the state of the rack in a snapshot."""

    def show_event(self, event: Event) -> None:
        """Show an event if `is_worth_showing` returns True for it."""
        if is_worth_showing(event):
            self.print_event(format_event(event))

    def print_event(self, text: Text) -> None:
        """Print an event."""


class LiveDisplay(Display):
    """Shows a run as a table that is redrawn in place."""

    period_s = 0.2

    def __init__(self, live: Live) -> None:
        self._live = live

    def show(self, snapshot: Snapshot) -> None:
        """Redraw the table."""
        self._live.update(RackView(snapshot), refresh=True)

    def print_event(self, text: Text) -> None:
        """Print the event above the table."""
        # Let the terminal wrap the line instead of rich, so that a command in it can be copied.
        self._live.console.print(text, soft_wrap=True)


class PlainDisplay(Display):
    """Shows a run as one line per second, on `stream`."""

    period_s = 1.0

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._next = 0.0

    def show(self, snapshot: Snapshot) -> None:
        """Print the state of the rack as one line, once a second and at the end."""
        now = time.monotonic()
        if now >= self._next or snapshot.run == "stopped":
            self._next = now + self.period_s
            print_text([format_line(snapshot)], self._stream)

    def print_event(self, text: Text) -> None:
        """Print the event."""
        print(text, file=self._stream, flush=True)


@contextmanager
def open_display(silent: bool, stream: TextIO) -> Iterator[Display]:
    """Provide the display that suits stdout, or a silent one.

    Args:
        silent: Whether to show nothing.
        stream: Output for the lines that are printed if stdout is not a terminal.
    """
    terminal = create_console()
    if silent:
        yield Display()
    elif terminal.is_terminal:
        from rich.live import Live

        with Live(console=terminal, auto_refresh=False) as live:
            yield LiveDisplay(live)
    else:
        yield PlainDisplay(stream)


@dataclass(frozen=True)
class RackView:
    """A snapshot that rich can draw.

    It has a head line, tables of tasks, hosts and network, queues, faults, holds and progress.

    Attributes:
        lateness: Dictionary from task to a sparkline of its lateness. Empty for no such column.
    """

    snapshot: Snapshot
    lateness: Mapping[str, str] = field(default_factory=dict)

    def __rich_console__(
        self, terminal: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Yield the texts and tables of the view, fitted to the width of the terminal."""
        snapshot = self.snapshot
        width = options.max_width
        yield _format_head(snapshot)
        names = [row.task for row in snapshot.tasks]
        columns = {
            name: [str(cell(row)) for row in snapshot.tasks] for name, cell in COLUMNS.items()
        }
        if self.lateness:
            columns["lateness"] = [self.lateness[name] for name in names]
        reasons = dict(zip(names, _list_reasons(snapshot), strict=True))
        has_space = width > WHY_LEAST_WIDTH
        if has_space and any(reasons.values()):
            columns["why"] = [*reasons.values()]
        cells = [*zip(*columns.values(), strict=True)]
        yield build_grid([*columns], cells, width, DROPPED, _choose_style)
        yield from (Text(f"{row.task}: {row.row}") for row in snapshot.tasks if row.row)
        if not has_space:
            yield from (Text(f"{name}: {why}", HOLD_STYLE) for name, why in reasons.items() if why)
        tables: tuple[Sequence[Any], ...] = (
            snapshot.hosts,
            snapshot.entries,
            snapshot.peers,
            snapshot.imports,
            snapshot.exports,
        )
        for rows in tables:
            if records := [asdict(row) for row in rows]:
                texts = [[_format_cell(*pair) for pair in row.items()] for row in records]
                yield Text()
                yield build_grid(
                    [key.replace("_", " ") for key in records[0]], texts, width, style=_choose_style
                )
        described: list[Any] = [*snapshot.queues, *snapshot.inboxes, *snapshot.standbys]
        yield from (Text(each.line) for each in described)
        yield from (Text(_format_exchange(*ages)) for ages in snapshot.exchanges.items())
        yield from (Text(f"fault: {fault}", style="magenta") for fault in snapshot.faults)
        for hold in snapshot.holds:
            if hold.task not in names:
                yield Text(hold.line, HOLD_STYLE)
            elif hold.release:
                yield Text(f"to release {hold.level}: {hold.release}", HOLD_STYLE)
        if (at := snapshot.progress) is not None:
            actions = f"{at.actions_done}/{at.actions}"
            yield Text(f"task: action {actions}, move {at.moves_done}/{at.moves} {at.state}")


def _format_cell(column: str, value: Any) -> str:
    """Format a cell. The unit in its column's name determines the number of decimals."""
    if not isinstance(value, float | None):
        return str(value)
    digits = {"s": 3, "ticks": 0}
    return format_decimal(value, digits.get(column.rpartition("_")[2], 1))


def format_line(snapshot: Snapshot) -> str:
    """Format a snapshot as one short line, which counts holds and faults without details."""
    counts = {
        "missed": sum(row.missed for row in snapshot.tasks),
        "skipped": sum(row.skipped for row in snapshot.tasks),
        "lost": sum(row.state == LOST for row in snapshot.tasks),
        "holds": len(snapshot.holds),
        "faults": len(snapshot.faults),
    }
    parts = [f"{snapshot.rack} {snapshot.time_s:.2f} s", f"tick {snapshot.tick}"]
    parts += [snapshot.run] if snapshot.run == DEAD else []
    parts += [f"{name} {n}" for name, n in counts.items() if n or name in LOSSES]
    at = snapshot.progress
    parts += [f"task {at.state} {at.moves_done}/{at.moves}"] if at is not None else []
    # Keep only the part of a warning before the colon. The details are for the table.
    return "  ".join(
        [
            *parts,
            *(line.partition(":")[0] for line in snapshot.lines),
            *_list_active_demand(snapshot),
        ]
    )


def _format_head(snapshot: Snapshot) -> Text:
    """Return the head line: state of the run, time, and warnings."""
    line = Text(
        f"rack {snapshot.rack}: {snapshot.run}, {snapshot.time_s:.2f} s, tick {snapshot.tick}"
    )
    if snapshot.run == DEAD:
        line.append("; its launcher is gone: 'rack clean' removes it", style="bold red")
    if snapshot.clock_skipped:
        line.append(f", clock skipped {snapshot.clock_skipped} ticks", style="yellow")
    for name in [*snapshot.lines, *_list_active_demand(snapshot)]:
        line.append(f"  {name}", style="bold red")
    return line


def _list_active_demand(snapshot: Snapshot) -> list[str]:
    """Return a list with the demand on the arm (stop or brake) as text. Empty if there is none."""
    return [f"arm: {snapshot.demand}"] if snapshot.demand != NO_DEMAND else []


def _list_reasons(snapshot: Snapshot) -> Iterator[str]:
    """Yield for each task why it holds, or what it reports. A relayed reason is shortened."""
    shown: list[str] = []
    for row in snapshot.tasks:
        texts = [hold.text for hold in snapshot.holds if hold.task == row.task][:1]
        if row.reason and not (texts and row.state == "holding"):
            is_new = is_new_reason(row.reason, shown)
            texts.append(row.reason if is_new else row.reason.partition(":")[0])
        yield "; ".join(texts).removeprefix("holding: ")


def _format_exchange(board: str, ports: Mapping[str, PortAge]) -> str:
    """Format the ages of a board's exchanged messages as one line."""
    ages = [f"{port} {age.age} ticks old, taken at tick {age.taken}" for port, age in ports.items()]
    return f"exchange of {board}: {'; '.join(ages) or 'no message yet'}"


def _choose_style(column: str, text: str) -> str:
    """Return the style of a cell: for a state, or for a count above 0. Empty for other cells."""
    if column == "state":
        return STATE_STYLES.get(text.partition(" (")[0], "")
    return COUNT_STYLES.get(column, "") if text != "0" else ""


def is_worth_showing(event: Event) -> bool:
    """Return whether to show an event in addition to the table.

    Events whose kind is in `HIDDEN_EVENTS` are not shown, nor is braking for lack of torque if it
    was shorter than `BRIEF_TICKS`.
    """
    is_brief = event.subject == NO_TORQUE and event.value < BRIEF_TICKS
    return event.kind not in HIDDEN_EVENTS and not is_brief


def format_event(event: Event) -> Text:
    """Format an event as one line, in the colour of its kind."""
    tick = f"tick {event.tick} " if event.code else ""
    board = f"{event.board}: " if event.board else ""
    style = EVENT_STYLES.get(event.kind, DEFAULT_EVENT_STYLE)
    return Text(f"{tick}{event.kind}: {board}{event.text}", style)
