"""Signals of a running rack as they are written, from the rings of their mailboxes: no message is
missed, and no board is held up.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.tools.recording.signal import Signal

if TYPE_CHECKING:
    from rich.console import Console

Rows = list[tuple[int, list[Any]]]
"""Ticks, and the value of each signal at each; None before a signal's first one."""


class Written(NamedTuple):
    """Messages of one mailbox, oldest first, with the ticks at which they were released; before
    them, `lost` were overwritten.
    """

    mailbox: str
    ticks: np.ndarray
    messages: np.ndarray
    lost: int


class SignalTap:
    """Takes what is written to the mailboxes of some signals."""

    def __init__(self, segment: Segment, signals: Sequence[Signal]) -> None:
        names = dict.fromkeys(signal.mailbox for signal in signals)
        self._rings = {name: MailboxRing(segment, name) for name in names}

    def take(self) -> Iterator[Written]:
        """Yield what was written since the last call; at the first one, what the rings still hold:
        2 s of simulated time.
        """
        for name, ring in self._rings.items():
            rows, lost = ring.drain()
            if len(rows) or lost:
                yield Written(name, rows["tick"], rows["message"], lost)


class Strip:
    """The last values of some signals by tick. A signal keeps its value until its next message.

    Attributes:
        settles: Ticks after which everything released at a tick has been written.
        lost: Messages that were overwritten before they were taken.
    """

    def __init__(
        self,
        segment: Segment,
        signals: Sequence[Signal],
        span: int,
        followed: Sequence[Signal] = (),
    ) -> None:
        """Keep `span` ticks, and for each mailbox the message before them; of signals that are only
        `followed`, nothing.
        """
        specs = [segment.layout.mailbox(signal.mailbox) for signal in signals]
        self.signals = signals
        self.tick_s = segment.layout.clock_ns * 1e-9
        # A message is written before its writer's next period, and visible then.
        self.settles = max(spec.every + spec.delay for spec in specs)
        # One look may bring as much as a ring holds.
        self._span = span + self.settles + max(spec.every * spec.depth for spec in specs)
        self._changes: dict[str, deque[tuple[int, dict[str, Any]]]] = defaultdict(deque)
        """Of each mailbox ticks, and the values of its signals by name."""
        self._tap = SignalTap(segment, [*signals, *followed])
        self.lost = 0
        self.take()
        # What was overwritten before anyone asked does not count.
        self.lost = 0

    def take(self) -> list[Written]:
        """Take what was written since the last call, and return it."""
        found = [*self._tap.take()]
        for written in found:
            self.lost += written.lost
            own = [signal for signal in self.signals if signal.mailbox == written.mailbox]
            if own:
                names = [signal.name for signal in own]
                values = zip(*(signal.plain(written.messages) for signal in own), strict=True)
                named = (dict(zip(names, row, strict=True)) for row in values)
                changes = self._changes[written.mailbox]
                changes.extend(zip(written.ticks.tolist(), named, strict=True))
                while len(changes) > 1 and changes[1][0] < changes[-1][0] - self._span:
                    changes.popleft()
        return found

    def table(self, first: int, last: int) -> Rows:
        """Return a row for each tick from `first` to `last` at which one of the signals was
        released.
        """
        changes = [one for many in self._changes.values() for one in many if one[0] <= last]
        newest: dict[str, Any] = {}
        table: dict[int, list[Any]] = {}
        for tick, values in sorted(changes, key=lambda change: change[0]):
            newest.update(values)
            if tick >= first:
                table[tick] = [newest.get(signal.name) for signal in self.signals]
        return [*table.items()]

    def time_s(self, tick: int) -> float:
        """Return the simulated time of a tick, s."""
        return round(tick * self.tick_s, 9)


def cell(value: Any) -> str:
    """Return a value as text."""
    if isinstance(value, list):
        return " ".join(map(cell, value))
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Lines:
    """Signals as lines of text, or of JSON documents: one every `every` ticks, or with 0 one for
    each tick at which a signal was released; the `first` tick begins.
    """

    def __init__(self, strip: Strip, first: int, every: int, as_json: bool) -> None:
        self._strip = strip
        self._next = first
        self._every = max(every, 1)
        self._as_json = as_json

    def show(self, last: int) -> None:
        """Print what was released until the tick `last`, and is not printed yet."""
        for tick, values in self._strip.table(self._next, last):
            if tick >= self._next:
                self._print(tick, values)
                self._next = tick + self._every

    def _print(self, tick: int, values: list[Any]) -> None:
        time_s = self._strip.time_s(tick)
        if self._as_json:
            names = [signal.name for signal in self._strip.signals]
            line = {"time_s": time_s, "tick": tick, **dict(zip(names, values, strict=True))}
            print(encode_json(line), flush=True)
        else:
            print(f"{time_s:10.4f}", *map(cell, values), sep="  ", flush=True)


class Plot:
    """Signals as curves on the terminal: `span` ticks of them. Raises `ImportError` without
    plotext.
    """

    def __init__(self, strip: Strip, span: int, terminal: Console) -> None:
        import plotext
        from rich.live import Live

        self._plotext = plotext
        self._strip = strip
        self._span = span
        self._live = Live(console=terminal, auto_refresh=False, vertical_overflow="crop")

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def show(self, last: int) -> None:
        """Draw what was released in the time before the tick `last`."""
        from rich.text import Text

        rows = self._strip.table(last - self._span, last)
        plot = self._plotext
        plot.clear_figure()
        plot.theme("clear")  # the terminal's own colours
        # One line less: else the terminal scrolls.
        plot.plotsize(self._live.console.width, max(self._live.console.height - 1, 4))
        plot.xlabel("simulated time, s")
        for name, points in self._curves(rows).items():
            times, values = zip(*points, strict=True)
            plot.plot(times, values, label=name, marker="braille")
        self._live.update(Text.from_ansi(plot.build()), refresh=True)

    def _curves(self, rows: Rows) -> dict[str, list[tuple[float, float]]]:
        """Return points by the name of the curve: a signal with several numbers has one for
        each.
        """
        curves = defaultdict(list)
        for tick, values in rows:
            for signal, value in zip(self._strip.signals, values, strict=True):
                for name, number in _numbers(signal.head, value):
                    curves[name].append((self._strip.time_s(tick), number))
        return curves


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a value, each with its name."""
    if isinstance(value, list):
        for index, part in enumerate(value):
            yield from _numbers(f"[{index}] {name}", part)
    elif isinstance(value, int | float):
        yield name, value
