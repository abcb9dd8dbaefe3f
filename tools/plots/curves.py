"""Curves of signals, arranged so that signals of the same unit share a panel."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from rack.tools.console.answer import Document, Failure
from rack.tools.plots.marks import Mark
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal

MAX_CURVES = 32
"""Largest number of curves in a plot."""


class Series(NamedTuple):
    """Values of a signal over simulated time. A value holds until the next one.

    Attributes:
        signal: The signal, which is not a text.
        time_s: Times at which the messages were released, shape (messages,).
        values: Values in the unit of the signal, shape (messages, *shape of one value). States are
            given as numbers.
        run: Name of the run, if several are plotted.
        is_other: True for the run that is compared with.
    """

    signal: Signal
    time_s: np.ndarray
    values: np.ndarray
    run: str = ""
    is_other: bool = False

    @classmethod
    def read(
        cls, recording: Recording, signal: Signal, run: str = "", is_other: bool = False
    ) -> Self:
        """Read a signal of a recorded run. Raises `Failure` if none of its messages is recorded.

        Args:
            recording: The run.
            signal: The signal.
            run: Name of the run, if several are plotted.
            is_other: True for the run that is compared with.
        """
        ticks = recording.read_signal(signal.mailbox, "tick")
        if not len(ticks):
            raise Failure(f"{signal.name}: no message of {signal.mailbox} is recorded", 2)
        values = signal.select_part(recording.read_signal(signal.mailbox, signal.label))
        return cls(signal, ticks * (recording.layout.clock_ns * 1e-9), values, run, is_other)

    def cut(self, from_s: float, to_s: float) -> Self:
        """Return the messages in a window of time, and the last one before it."""
        first = max(int(np.searchsorted(self.time_s, from_s, "right")) - 1, 0)
        end = int(np.searchsorted(self.time_s, to_s, "right"))
        return self._replace(time_s=self.time_s[first:end], values=self.values[first:end])

    def find_first_difference_s(self, other: Series) -> float | None:
        """Return the first time at which two series differ, within the time that both cover."""
        if not (len(self.time_s) and len(other.time_s)):
            return None
        from_s = max(self.time_s[0], other.time_s[0])
        to_s = min(self.time_s[-1], other.time_s[-1])
        here, there = (
            series._replace(time_s=series.time_s[inside], values=series.values[inside])
            for series in (self, other)
            for inside in [(series.time_s >= from_s) & (series.time_s <= to_s)]
        )
        count = min(len(here.time_s), len(there.time_s))
        is_equal = np.isclose(here.values[:count], there.values[:count], 0, 0, equal_nan=True)
        is_equal = is_equal.reshape(count, -1).all(axis=1)
        is_equal &= np.isclose(here.time_s[:count], there.time_s[:count], 0, 1e-9)
        at = int(np.argmin(is_equal)) if not is_equal.all() else count
        times_s = [float(series.time_s[at]) for series in (here, there) if at < len(series.time_s)]
        return min(times_s, default=None)

    def to_document(self) -> Document:
        """Return the series as plain data. States are given by name."""
        return {
            "signal": self.signal.name,
            "unit": self.signal.unit,
            "run": self.run,
            "time_s": np.round(self.time_s, 9).tolist(),
            "values": self.signal.replace_numbers(self.values).tolist(),
        }


class Curve(NamedTuple):
    """A single number over simulated time.

    Attributes:
        label: Text in the legend.
        number: Number of the curve among those of its run in the panel.
        time_s: Times, shape (messages,).
        values: Values, shape (messages,).
        is_other: True for the run that is compared with.
    """

    label: str
    number: int
    time_s: np.ndarray
    values: np.ndarray
    is_other: bool


class Panel(NamedTuple):
    """Curves with a common axis of values.

    Attributes:
        label: Label of the axis, with the unit.
        names: Pairs of a state and the number that stands for it.
        curves: The curves.
    """

    label: str
    names: tuple[tuple[str, int], ...]
    curves: list[Curve]


class Plot(NamedTuple):
    """A plot of signals.

    Attributes:
        title: Title of the plot.
        series: The signals. Each has messages in the window, or one before it.
        marks: Marks in the window, earliest first.
        window_s: Beginning and end of the plotted time.
    """

    title: str
    series: list[Series]
    marks: list[Mark]
    window_s: tuple[float, float]

    def to_document(self) -> Document:
        """Return the plotted values and marks as plain data."""
        return {
            "title": self.title,
            "from_s": self.window_s[0],
            "to_s": self.window_s[1],
            "curves": [series.to_document() for series in self.series],
            "marks": [mark._asdict() for mark in self.marks],
        }


def require_number(signal: Signal) -> None:
    """Raise `Failure` if a signal is a text."""
    if signal.is_text:
        raise Failure(f"{signal.name}: is a text; only numbers can be plotted", 2)


def build_panels(all_series: Sequence[Series]) -> list[Panel]:
    """Return a panel for each unit and each set of states, in the order of the series."""
    groups: defaultdict[tuple[object, ...], list[Series]] = defaultdict(list)
    for series in all_series:
        groups[series.signal.unit, series.signal.spec.values].append(series)
    panels = []
    for group in groups.values():
        signal = group[0].signal
        is_one = len({series.signal.name for series in group}) == 1
        curves: list[Curve] = []
        numbers = Counter[bool]()
        for series in group:
            for index in np.ndindex(series.values.shape[1:]):
                place = "".join(f"[{number}]" for number in index)
                whole = "" if is_one and (place or series.run) else series.signal.name
                label = ", ".join(filter(None, (f"{whole}{place}", series.run)))
                values = series.values[(slice(None), *index)]
                number = numbers[series.is_other]
                curves.append(Curve(label, number, series.time_s, values, series.is_other))
                numbers[series.is_other] += 1
        panels.append(Panel(signal.heading if is_one else signal.unit, signal.spec.values, curves))
    return panels
