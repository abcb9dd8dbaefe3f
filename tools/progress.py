"""How far a command of many runs is: a bar on a terminal, plain lines elsewhere, nothing beside JSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from rack.tools.live_table import console


class Progress(Protocol):
    """Shows it. Its measure is the time that things take, about, in s."""

    def total(self, seconds: float) -> None:
        """Take what everything takes together."""

    def begin(self, text: str) -> None:
        """Show what begins."""

    def end(self, seconds: float, ended: str, shortfalls: Sequence[str]) -> None:
        """Show how it ended; it was worth so many seconds."""


class Bar:
    """A bar that moves when a run ends; shortfalls stand above it."""

    def __init__(self, bar: RichProgress) -> None:
        self._bar = bar
        self._task = bar.add_task("", total=None)

    def total(self, seconds: float) -> None:
        """Take what everything takes together."""
        self._bar.update(self._task, total=seconds)

    def begin(self, text: str) -> None:
        """Show what begins."""
        self._bar.update(self._task, description=text)

    def end(self, seconds: float, ended: str, shortfalls: Sequence[str]) -> None:
        """Move the bar."""
        self._bar.update(self._task, advance=seconds)
        for line in shortfalls:
            self._bar.console.print(line, style="red", highlight=False, markup=False)


class Lines:
    """A line when something begins and one for how it ended."""

    def total(self, seconds: float) -> None:
        """Print what everything takes together."""
        print(f"about {seconds / 60.0:.0f} minutes", flush=True)

    def begin(self, text: str) -> None:
        """Print what begins."""
        print(text, flush=True)

    def end(self, seconds: float, ended: str, shortfalls: Sequence[str]) -> None:
        """Print how it ended."""
        print(f"  {ended}", flush=True)
        for line in shortfalls:
            print(f"  {line}", flush=True)


class Silent:
    """Nothing: stdout is for one JSON document."""

    def total(self, seconds: float) -> None:
        """Show nothing."""

    def begin(self, text: str) -> None:
        """Show nothing."""

    def end(self, seconds: float, ended: str, shortfalls: Sequence[str]) -> None:
        """Show nothing."""


@contextmanager
def progress_for(silent: bool) -> Iterator[Progress]:
    """Give the progress that fits where stdout goes."""
    terminal = console()
    if silent:
        yield Silent()
    elif terminal.is_terminal:
        columns = (BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        with RichProgress(*columns, console=terminal) as bar:
            yield Bar(bar)
    else:
        yield Lines()
