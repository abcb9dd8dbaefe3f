"""What a run shows while it lasts: a live table on a terminal, a line a second elsewhere, nothing beside JSON."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.live import Live

from rack.boards.events import Event
from rack.tools.live_table import console, line_of, table_of
from rack.tools.snapshot import Snapshot

QUIET = ("launch", "start", "end", "miss")
"""Events that the view itself shows: the table counts the misses."""
BRIEF_TICKS = 10
"""Ticks for which brakes that closed by themselves, after missed cycles, are counted and not told."""
STYLES = {"fault": "magenta", "detection": "yellow", "reaction": "red", "recovery": "green"}
OTHERS = "yellow"
"""Colour of events that are no part of a fault's course."""


class Display(Protocol):
    """Shows a run. `period_s` is the time between looks."""

    period_s: float

    def show(self, snapshot: Snapshot) -> None:
        """Show the rack as it is now."""

    def tell(self, event: Event) -> None:
        """Show an event."""


class LiveDisplay:
    """A table that changes in place."""

    period_s = 0.2

    def __init__(self, live: Live) -> None:
        self._live = live

    def show(self, snapshot: Snapshot) -> None:
        """Draw the table anew."""
        self._live.update(table_of(snapshot), refresh=True)

    def tell(self, event: Event) -> None:
        """Print the event above the table."""
        if _is_told(event):
            style = STYLES.get(event.kind, OTHERS)
            self._live.console.print(_line(event), style=style, highlight=False, markup=False)


class PlainDisplay:
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

    def tell(self, event: Event) -> None:
        """Print the event."""
        if _is_told(event):
            print(_line(event), flush=True)


class SilentDisplay:
    """Nothing: stdout is for one JSON document."""

    period_s = 0.5

    def show(self, snapshot: Snapshot) -> None:
        """Show nothing."""

    def tell(self, event: Event) -> None:
        """Show nothing; the event is in the log."""


def _is_told(event: Event) -> bool:
    """Say whether an event is worth a line of its own."""
    is_brief = event.code == "brakes_closed" and 0 < event.value < BRIEF_TICKS
    return event.kind not in QUIET and not is_brief


def _line(event: Event) -> str:
    who = f"{event.board}: " if event.board else ""
    return f"{f'tick {event.tick} ' if event.code else ''}{event.kind}: {who}{event.text}"


@contextmanager
def display_for(silent: bool) -> Iterator[Display]:
    """Give the display that fits where stdout goes."""
    terminal = console()
    if silent:
        yield SilentDisplay()
    elif terminal.is_terminal:
        with Live(console=terminal, auto_refresh=False) as live:
            yield LiveDisplay(live)
    else:
        yield PlainDisplay()
