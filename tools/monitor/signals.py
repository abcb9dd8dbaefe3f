"""Follows signals of a running rack in the rings of their mailboxes.

No message is missed, and no board is delayed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.tools.plots.curves import Plot, Series, split_values
from rack.tools.plots.terminal import draw_plot
from rack.tools.recording.signal import Signal

if TYPE_CHECKING:
    from rich.live import Live

SignalRows = list[tuple[int, tuple[Any, ...]]]
"""Rows of a tick and the value of each signal, None before the first message of the signal."""


class SignalHistory:
    """Recent messages of the mailboxes of signals. A signal keeps its value until its next message.

    Attributes:
        settling_ticks: Number of ticks within which all messages released at a tick are written.
        lost: Number of messages that were overwritten before they were read.

    Args:
        segment: The rack.
        signals: Signals whose values are listed.
        span: Number of ticks to store. At least one earlier message of each mailbox is stored, too.
        followed: Further signals, whose messages `read_new` returns as well.
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
        names = {signal.mailbox for signal in (*signals, *followed)}
        self._rings = {name: MailboxRing(segment, name) for name in names}
        # For each mailbox, blocks of rows, which are not empty except for the first one.
        self._blocks = {
            name: deque([ring.read_new_rows().rows]) for name, ring in self._rings.items()
        }
        self.lost = 0

    def read_new(self) -> dict[str, np.ndarray]:
        """Store and return the rows since the last call, keyed by mailbox."""
        new_rows = {}
        for name, ring in self._rings.items():
            rows, lost = ring.read_new_rows()
            self.lost += lost
            new_rows[name] = rows
            blocks = self._blocks[name]
            if len(rows):
                blocks.append(rows)
                while len(blocks) > 1 and blocks[1]["tick"][0] < rows["tick"][-1] - self._span:
                    blocks.popleft()
        return new_rows

    def _select_rows(self, signal: Signal, first: int, last: int) -> np.ndarray:
        """Return the stored rows of a signal from the last one before `first` to tick `last`."""
        rows = np.concatenate(self._blocks[signal.mailbox])
        begin, end = np.searchsorted(rows["tick"], (first, last + 1)).tolist()
        return rows[max(begin - 1, 0) : end]

    def list_rows(self, first: int, last: int) -> SignalRows:
        """Return a row of values for each tick from `first` to `last` that has a new message."""
        selected = [self._select_rows(signal, first, last) for signal in self.signals]
        ticks = np.unique(np.concatenate([rows["tick"] for rows in selected]))
        ticks = ticks[ticks >= first]
        columns = []
        for signal, rows in zip(self.signals, selected, strict=True):
            values = [None, *signal.extract_plain(rows["message"])]
            newest = np.searchsorted(rows["tick"], ticks, "right").tolist()
            columns.append([values[index] for index in newest])
        return [*zip(ticks.tolist(), zip(*columns, strict=True), strict=True)]

    def build_series(self, first: int, last: int) -> list[Series]:
        """Return the values of the signals in a range of ticks. Texts are left out."""
        all_series = []
        for signal in self.signals:
            if not signal.is_text:
                rows = self._select_rows(signal, first, last)
                values = signal.extract_values(rows["message"])
                all_series += split_values(signal, rows["tick"] * self.tick_s, values)
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


def build_printer(
    history: SignalHistory, first: int, every: int, as_json: bool
) -> Callable[[int], None]:
    """Return a function that prints the new lines of signals up to a tick, as text or JSON.

    Args:
        history: History of the signals.
        first: Tick of the first line.
        every: Number of ticks between two lines. 0 for a line at each tick with a new message.
        as_json: True to print JSON documents.
    """
    names = [signal.name for signal in history.signals]
    following = first

    def show_until(last: int) -> None:
        """Print the lines up to the tick `last` that have not been printed yet."""
        nonlocal following
        for tick, values in history.list_rows(following, last):
            if tick >= following:
                following = tick + max(every, 1)
                time_s = history.to_time_s(tick)
                if as_json:
                    line = {"time_s": time_s, "tick": tick, **dict(zip(names, values, strict=True))}
                    print(encode_json(line), flush=True)
                else:
                    print(f"{time_s:10.4f}", *map(format_value, values), sep="  ", flush=True)

    return show_until


def show_plot(history: SignalHistory, span: int, live: Live, last: int) -> None:
    """Draw the curves of signals on the terminal.

    Args:
        history: History of the signals.
        span: Number of ticks that the plot covers.
        live: Display of the terminal.
        last: Tick at which the plot ends.
    """
    first = max(last - span, 0)
    window_s = history.to_time_s(first), history.to_time_s(max(last, 1))
    plot = Plot("", history.build_series(first, last), [], window_s)
    # Leave one line free, because the terminal would scroll otherwise.
    live.update(draw_plot(plot, live.console, live.console.height - 1), refresh=True)
