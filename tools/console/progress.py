"""Shows progress: a bar on a terminal, plain lines elsewhere, nothing with --json."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Timer

from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from rack.tools.console.tables import create_console

LINE_INTERVAL_S = 2.0
"""Minimum time between two lines about the progress of reading."""


class Progress:
    """Progress of a series of runs, weighted by their expected durations.

    It is shown as a bar, as printed lines, or not at all.
    """

    def __init__(self, bar: RichProgress | None = None, prints_lines: bool = False) -> None:
        self._bar = bar or RichProgress(disable=True)
        self._prints_lines = prints_lines
        self._task = self._bar.add_task("", total=None)

    def set_total(self, seconds: float) -> None:
        """Set the expected duration of the whole series in s."""
        self._bar.update(self._task, total=seconds)
        self._print(f"about {seconds / 60.0:.0f} minutes")

    def begin_run(self, text: str) -> None:
        """Show a text about the run that begins."""
        self._bar.update(self._task, description=text)
        self._print(text)

    def end_run(self, seconds: float, ended: str = "done", shortfalls: Sequence[str] = ()) -> None:
        """Advance the progress by a run that has ended.

        Args:
            seconds: Expected duration of the run.
            ended: How the run ended. Printed only in line mode.
            shortfalls: Failures of the run, one line each.
        """
        self._bar.update(self._task, advance=seconds)
        if not self._bar.disable:
            for line in shortfalls:
                self._bar.console.print(line, style="red", highlight=False, markup=False)
        for line in (ended, *shortfalls):
            self._print(f"  {line}")

    def _print(self, line: str) -> None:
        """Print a line if progress is shown as printed lines."""
        if self._prints_lines:
            print(line, flush=True)


@contextmanager
def open_progress(silent: bool) -> Iterator[Progress]:
    """Provide the progress display that suits stdout, or a silent one."""
    terminal = create_console()
    if silent or not terminal.is_terminal:
        yield Progress(prints_lines=not silent)
        return
    columns = (
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with RichProgress(*columns, console=terminal) as bar:
        yield Progress(bar)


def create_reading_progress(
    silent: bool, activity: str = "reading the run"
) -> Callable[[float], None]:
    """Return a function that prints progress on stderr, at most once per `LINE_INTERVAL_S`.

    The function takes the fraction of the work that is done, 0 to 1.
    """
    last_shown = time.monotonic()

    def show(fraction: float) -> None:
        """Print the progress if the last line is at least `LINE_INTERVAL_S` old."""
        nonlocal last_shown
        if not silent and time.monotonic() - last_shown > LINE_INTERVAL_S:
            last_shown = time.monotonic()
            print(f"{activity}: {fraction:.0%}", file=sys.stderr, flush=True)

    return show


@contextmanager
def announce_waiting(text: str, silent: bool) -> Iterator[None]:
    """Print a text on stderr if the context lasts longer than `LINE_INTERVAL_S`."""
    timer = Timer(LINE_INTERVAL_S, print, (text,), {"file": sys.stderr, "flush": True})
    if not silent:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()
