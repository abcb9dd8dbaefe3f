"""Follows signals of a running rack in the rings of their mailboxes.

No message is missed, and no board is delayed.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from math import nan
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.tools.plots.curves import Plot, Series
from rack.tools.plots.terminal import draw_plot
from rack.tools.recording.signal import Signal

if TYPE_CHECKING:
    from rich.console import Console

SignalRows = list[tuple[int, list[Any]]]
"""Rows of a tick and the value of each signal, None before the first message of the signal."""


class WrittenMessages(NamedTuple):
    """Messages of one mailbox, oldest first, with the ticks at which they were released.

    Attributes:
        lost: Number of earlier messages that were overwritten before they were read.
    """

    mailbox: str
    ticks: np.ndarray
    messages: np.ndarray
    lost: int


class SignalReader:
    """Reads all new messages in the mailboxes of some signals."""

    def __init__(self, segment: Segment, signals: Sequence[Signal]) -> None:
        names = dict.fromkeys(signal.mailbox for signal in signals)
        self._rings = {name: MailboxRing(segment, name) for name in names}

    def read_new(self) -> Iterator[WrittenMessages]:
        """Yield the messages since the last call.

        The first call yields the messages that are still in the rings, which cover up to 2 s.
        """
        for name, ring in self._rings.items():
            rows, lost = ring.read_new_rows()
            if len(rows) or lost:
                yield WrittenMessages(name, rows["tick"], rows["message"], lost)


class SignalHistory:
    """Recent values of signals. A signal keeps its value until its next message.

    Attributes:
        settling_ticks: Number of ticks within which all messages released at a tick are written.
        lost: Number of messages that were overwritten before they were read.

    Args:
        segment: The rack.
        signals: Signals whose values are stored.
        span: Number of ticks to store. One earlier message of each mailbox is stored as well.
        followed: Signals whose messages `read_new` returns without storing them.
    """

    def __init__(
        self,
        segment: Segment,
        signals: Sequence[Signal],
        span: int,
        followed: Sequence[Signal] = (),
    ) -> None:
        """Store the messages that are in the rings now."""
        specs = [segment.layout.find_mailbox(signal.mailbox) for signal in signals]
        self.signals = signals
        self.tick_s = segment.layout.clock_ns * 1e-9
        # A message is written, and becomes visible, before its writer's next period.
        self.settling_ticks = max(spec.every + spec.delay for spec in specs)
        # One reading may return all messages of a ring.
        self._span = span + self.settling_ticks + max(spec.every * spec.depth for spec in specs)
        self._changes: dict[str, deque[tuple[int, dict[str, Any]]]] = defaultdict(deque)
        """For each mailbox, ticks with the values of its signals, keyed by name."""
        self._reader = SignalReader(segment, [*signals, *followed])
        self.lost = 0
        self.read_new()
        # Messages overwritten before the start do not count.
        self.lost = 0

    def read_new(self) -> list[WrittenMessages]:
        """Read, store and return the messages since the last call."""
        all_written = [*self._reader.read_new()]
        for written in all_written:
            self.lost += written.lost
            mailbox_signals = [
                signal for signal in self.signals if signal.mailbox == written.mailbox
            ]
            if mailbox_signals:
                names = [signal.name for signal in mailbox_signals]
                values = zip(
                    *(signal.extract_plain(written.messages) for signal in mailbox_signals),
                    strict=True,
                )
                named_rows = (dict(zip(names, row, strict=True)) for row in values)
                changes = self._changes[written.mailbox]
                changes.extend(zip(written.ticks.tolist(), named_rows, strict=True))
                while len(changes) > 1 and changes[1][0] < changes[-1][0] - self._span:
                    changes.popleft()
        return all_written

    def list_rows(self, first: int, last: int) -> SignalRows:
        """Return a row of values for each tick from `first` to `last` that has a new message."""
        changes = [
            change
            for mailbox_changes in self._changes.values()
            for change in mailbox_changes
            if change[0] <= last
        ]
        newest: dict[str, Any] = {}
        table: dict[int, list[Any]] = {}
        for tick, values in sorted(changes, key=lambda change: change[0]):
            newest.update(values)
            if tick >= first:
                table[tick] = [newest.get(signal.name) for signal in self.signals]
        return [*table.items()]

    def build_series(self, last: int) -> list[Series]:
        """Return the stored values of the signals up to tick `last`. Texts are left out."""
        all_series = []
        for signal in self.signals:
            if signal.is_text:
                continue
            rows = [row for row in self._changes[signal.mailbox] if row[0] <= last]
            numbers: dict[Any, float] = dict(signal.spec.values)
            numbers[None] = nan
            values = np.array([values[signal.name] for _, values in rows], object)
            values = np.array([numbers.get(value, value) for value in values.flat], float)
            shape = signal.shape[len(signal.index) :]
            times_s = np.array([tick for tick, _ in rows]) * self.tick_s
            all_series.append(Series(signal, times_s, values.reshape(len(rows), *shape)))
        return all_series

    def to_time_s(self, tick: int) -> float:
        """Convert a tick to simulated time in s."""
        return round(tick * self.tick_s, 9)


def format_value(value: Any) -> str:
    """Format a value of a signal."""
    if isinstance(value, list):
        return " ".join(map(format_value, value))
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class SignalPrinter:
    """Prints signals as lines of text or JSON.

    Args:
        history: History of the signals.
        first: Tick of the first line.
        every: Number of ticks between two lines. 0 for a line at each tick with a new message.
        as_json: True to print JSON documents.
    """

    def __init__(self, history: SignalHistory, first: int, every: int, as_json: bool) -> None:
        self._history = history
        self._next = first
        self._every = max(every, 1)
        self._as_json = as_json

    def show_until(self, last: int) -> None:
        """Print the lines up to the tick `last` that have not been printed yet."""
        for tick, values in self._history.list_rows(self._next, last):
            if tick >= self._next:
                self._print_line(tick, values)
                self._next = tick + self._every

    def _print_line(self, tick: int, values: list[Any]) -> None:
        """Print the values of all signals at a tick."""
        time_s = self._history.to_time_s(tick)
        if self._as_json:
            names = [signal.name for signal in self._history.signals]
            line = {"time_s": time_s, "tick": tick, **dict(zip(names, values, strict=True))}
            print(encode_json(line), flush=True)
        else:
            print(f"{time_s:10.4f}", *map(format_value, values), sep="  ", flush=True)


class SignalPlot:
    """Draws signals as curves on the terminal. Raises `ImportError` without plotext.

    Args:
        history: History of the signals.
        span: Number of ticks that the plot covers.
        terminal: Console on which the plot is drawn.
    """

    def __init__(self, history: SignalHistory, span: int, terminal: Console) -> None:
        # Fail before the first plot.
        import plotext  # noqa: F401
        from rich.live import Live

        self._history = history
        self._span_s = history.to_time_s(span)
        self._live = Live(console=terminal, auto_refresh=False, vertical_overflow="crop")

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show_until(self, last: int) -> None:
        """Redraw the curves up to tick `last`."""
        to_s = self._history.to_time_s(last)
        window_s = max(to_s - self._span_s, 0.0), max(to_s, self._history.tick_s)
        series = [series.cut(*window_s) for series in self._history.build_series(last)]
        # Leave one line free, because the terminal would scroll otherwise.
        console = self._live.console
        drawn = draw_plot(Plot("", series, [], window_s), console, console.height - 1)
        self._live.update(drawn, refresh=True)
