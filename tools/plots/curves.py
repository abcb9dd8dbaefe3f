"""Values of signals over simulated time, grouped so that signals of the same unit share a panel."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from rack.tools.console.answer import Document, Failure
from rack.tools.plots.marks import Mark
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal


class Series(NamedTuple):
    """Values of a signal over simulated time. A value holds until the next one.

    Attributes:
        signal: The signal, which is not a text.
        time_s: Times at which the messages were released, shape (messages,).
        values: Values in the unit of the signal, shape (messages, *shape of one value). States are
            given as numbers.
        run: Name of the run, if two are plotted.
    """

    signal: Signal
    time_s: np.ndarray
    values: np.ndarray
    run: str = ""

    @classmethod
    def read(cls, recording: Recording, signal: Signal, run: str = "") -> Self:
        """Read a signal of a recorded run.

        Args:
            recording: The run.
            signal: The signal.
            run: Name of the run, if two are plotted.

        Raises:
            Failure: The signal is a text, or none of its messages is recorded.
        """
        require_number(signal)
        ticks = recording.read_signal(signal.mailbox, "tick")
        times_s = np.round(ticks * recording.layout.clock_ns * 1e-9, 9)
        if not len(times_s):
            raise Failure(f"{signal.name}: no message of {signal.mailbox} is recorded", 2)
        values = recording.read_signal(signal.mailbox, signal.label)
        return cls(signal, times_s, signal.select_part(values), run)

    def cut(self, from_s: float, to_s: float) -> Self:
        """Return the messages in a window of time, and the last one before it."""
        first, end = np.searchsorted(self.time_s, (from_s, to_s), "right").tolist()
        chosen = slice(max(first - 1, 0), end)
        return self._replace(time_s=self.time_s[chosen], values=self.values[chosen])

    def find_difference(self, other: Series) -> Iterator[Mark]:
        """Yield a mark at the first time at which both have a message, and these differ."""
        times_s, *rows = np.intersect1d(self.time_s, other.time_s, return_indices=True)
        pair = self.values[rows[0]], other.values[rows[1]]
        is_equal = np.isclose(*pair, 0, 0, equal_nan=True).reshape(len(times_s), -1)
        for time_s in times_s[~is_equal.all(axis=1)][:1].tolist():
            yield Mark(time_s, "first difference", self.signal.name, time_s)


class PlottedCurve(NamedTuple):
    """One number of a signal over simulated time: its label in a legend, its times and values."""

    label: str
    time_s: np.ndarray
    values: np.ndarray


class SignalPanel(NamedTuple):
    """Curves with a common axis of values.

    Attributes:
        label: Label of the axis, with the unit.
        states: Names of the values, with their numbers. Empty for a quantity.
        runs: Curves of each run.
    """

    label: str
    states: tuple[tuple[str, int], ...]
    runs: list[list[PlottedCurve]]


class Plot(NamedTuple):
    """A plot of signals in a window of simulated time.

    Attributes:
        title: Title of the plot.
        series: The signals.
        marks: Marks in the window, earliest first.
        window_s: Beginning and end of the window.
    """

    title: str
    series: list[Series]
    marks: list[Mark]
    window_s: tuple[float, float]

    def to_document(self) -> Document:
        """Return the plotted values and marks as plain data. States are given by name."""
        return {
            "title": self.title,
            "window_s": self.window_s,
            "curves": [
                {
                    "signal": series.signal.name,
                    "unit": series.signal.unit,
                    "run": series.run,
                    "time_s": series.time_s.tolist(),
                    "values": series.signal.replace_numbers(series.values).tolist(),
                }
                for series in self.series
            ],
            "marks": [mark._asdict() for mark in self.marks],
        }


def require_number(signal: Signal) -> None:
    """Raise `Failure` if a signal is a text."""
    if signal.is_text:
        raise Failure(f"{signal.name}: is a text; only numbers can be plotted", 2)


def format_index(index: Sequence[int]) -> str:
    """Format an index, as in `[2][0]`."""
    return "".join(f"[{number}]" for number in index)


def build_panels(all_series: list[Series]) -> list[SignalPanel]:
    """Return a panel for each unit and each set of states, in the order of the series."""
    groups: defaultdict[object, list[Series]] = defaultdict(list)
    for series in all_series:
        groups[series.signal.unit, series.signal.spec.values].append(series)
    panels = []
    for group in groups.values():
        signal = group[0].signal
        is_alone = len({series.signal.name for series in group}) == 1
        runs: defaultdict[str, list[PlottedCurve]] = defaultdict(list)
        for series in group:
            for index in np.ndindex(series.values.shape[1:]):
                place = format_index(index)
                name = "" if is_alone and (place or series.run) else series.signal.name
                label = f"{name}{place} {series.run}".strip()
                values = series.values[(slice(None), *index)]
                runs[series.run].append(PlottedCurve(label, series.time_s, values))
        label = signal.heading if is_alone else signal.unit
        panels.append(SignalPanel(label, signal.spec.values, [*runs.values()]))
    return panels
