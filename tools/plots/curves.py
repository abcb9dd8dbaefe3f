"""Plots as data: values of signals over simulated time, and marks of what happened.

Signals of the same unit share a panel. Marks are faults, detections, missed cycles, holds, lost
boards and restarts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rack.tools.console.answer import Document, Failure
from rack.tools.recording.divergence import find_tick_range
from rack.tools.recording.history import list_holds, list_misses
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal

MAX_LEGEND_ENTRIES = 12
"""Largest number of curves and marks that a legend lists."""
MARKED_CODES = {"begins": "fault", "died": "lost", "rejoined": "restart"}
"""Kinds of marks by code of an event. Detections have many codes."""


class Mark(NamedTuple):
    """Something that happened at a simulated time.

    Attributes:
        time_s: Time at which it happened or began.
        kind: Kind of mark.
        text: Description.
        until_s: Time at which it ended. The same as `time_s` for an instant.
    """

    time_s: float
    kind: str
    text: str
    until_s: float


class Series(NamedTuple):
    """Values of one number of a signal over simulated time. A value holds until the next one.

    Attributes:
        signal: The signal, which may be an array.
        place: Index of the number in the signal, as in "[2]". Empty for a single number.
        time_s: Times at which the messages were released, shape (messages,).
        values: Values in the unit of the signal, shape (messages,). States are given as numbers.
        run: Name of the run, if two are plotted.
    """

    signal: Signal
    place: str
    time_s: np.ndarray
    values: np.ndarray
    run: str = ""

    @property
    def name(self) -> str:
        """Name of the number, as in `servo.status.position[2]`."""
        return f"{self.signal.name}{self.place}"

    def select_window(self, from_s: float, to_s: float) -> Series:
        """Return the messages in a window of time, and the last one before it."""
        first, end = np.searchsorted(self.time_s, (from_s, to_s), "right").tolist()
        chosen = slice(max(first - 1, 0), end)
        return self._replace(time_s=self.time_s[chosen], values=self.values[chosen])


class SignalPanel(NamedTuple):
    """Curves with a common axis of values.

    Attributes:
        label: Label of the axis, with the unit.
        states: Names of the values, with their numbers. Empty for a quantity.
        curves: Series by label. A single curve has no label.
    """

    label: str
    states: tuple[tuple[str, int], ...]
    curves: dict[str, Series]


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
                    "signal": series.name,
                    "unit": series.signal.unit,
                    "run": series.run,
                    "time_s": series.time_s.tolist(),
                    "values": series.signal.replace_numbers(series.values).tolist(),
                }
                for series in self.series
            ],
            "marks": [mark._asdict() for mark in self.marks],
        }


def split_values(
    signal: Signal, time_s: np.ndarray, values: np.ndarray, run: str = ""
) -> list[Series]:
    """Return a series for each number of a signal.

    Args:
        signal: The signal.
        time_s: Times at which the messages were released, shape (messages,).
        values: Values of the signal, shape (messages, *shape of one value).
        run: Name of the run, if two are plotted.

    Raises:
        Failure: The signal is a text.
    """
    if signal.is_text:
        raise Failure(f"{signal.name}: is a text; only numbers can be plotted", 2)
    return [
        Series(signal, format_index(index), time_s, values[(slice(None), *index)], run)
        for index in np.ndindex(values.shape[1:])
    ]


def read_series(recording: Recording, signal: Signal, run: str = "") -> list[Series]:
    """Read each number of a signal of a recorded run.

    Args:
        recording: The run.
        signal: The signal.
        run: Name of the run, if two are plotted.

    Raises:
        Failure: The signal is a text, or none of its messages is recorded.
    """
    ticks = recording.read_signal(signal.mailbox, "tick")
    if not len(ticks):
        raise Failure(f"{signal.name}: no message of {signal.mailbox} is recorded", 2)
    times_s = np.round(ticks * recording.layout.clock_ns * 1e-9, 9)
    values = recording.read_signal(signal.mailbox, signal.label)
    return split_values(signal, times_s, signal.select_part(values), run)


def format_index(index: Sequence[int]) -> str:
    """Format an index, as in `[2][0]`."""
    return "".join(f"[{number}]" for number in index)


def build_panels(all_series: Sequence[Series]) -> list[SignalPanel]:
    """Return a panel for each unit and each set of states, in the order of the series."""
    groups: defaultdict[object, list[Series]] = defaultdict(list)
    for series in all_series:
        groups[series.signal.unit, series.signal.spec.values].append(series)
    panels = []
    for group in groups.values():
        signal = group[0].signal
        is_alone = len({series.signal.name for series in group}) == 1
        curves = {
            f"{series.place if is_alone else series.name} {series.run}".strip(): series
            for series in group
        }
        label = signal.heading if is_alone else signal.unit
        panels.append(SignalPanel(label, signal.spec.values, curves))
    return panels


def list_marks(recording: Recording) -> list[Mark]:
    """Return the marks of a recorded run, earliest first."""
    tick_s = recording.layout.clock_ns * 1e-9
    instants = [
        (miss["tick"], "miss", f"{miss['task']} {miss['what']}") for miss in list_misses(recording)
    ]
    for event in recording.events:
        is_detection = event["kind"] == "detection"
        if kind := "detection" if is_detection else MARKED_CODES.get(event.get("code", "")):
            instants.append((event["tick"], kind, f"{event['board']}: {event['text']}"))
    marks = [
        Mark(time_s, kind, text, time_s)
        for tick, kind, text in instants
        for time_s in [round(tick * tick_s, 9)]
    ]
    end_s = find_tick_range(recording)[1] * tick_s
    for hold in list_holds(recording):
        until_s = end_s if hold["until_s"] is None else hold["until_s"]
        marks.append(Mark(hold["since_s"], "hold", f"{hold['level']}: {hold['why']}", until_s))
    return sorted(marks)


def group_marks(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Group equal marks, and return them by their entry in a legend.

    If there are too many entries, marks are grouped by kind.
    """
    groups: defaultdict[tuple[object, ...], list[Mark]] = defaultdict(list)
    is_by_text = len({mark[1:3] for mark in marks}) <= MAX_LEGEND_ENTRIES
    for mark in marks:
        groups[mark[1 : 2 + is_by_text]].append(mark)
    return {_format_entry(*group): group for group in groups.values()}


def _format_entry(first: Mark, *others: Mark) -> str:
    """Return the entry of a group: its first mark, and the number of the others."""
    until = f" to {first.until_s:g}" * (first.until_s > first.time_s)
    more = f" (and {len(others)} more)" * bool(others)
    return f"{first.kind}, {first.time_s:g}{until} s: {first.text}{more}"
