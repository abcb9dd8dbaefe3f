"""A recorded run for a Python program: its signals as arrays, as pandas tables and as curves."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rack.boards.events import Event
from rack.tools.console.answer import Document, Failure
from rack.tools.console.pictures import NO_PICTURES, can_draw
from rack.tools.launch.continued import parse_tick
from rack.tools.plots.curves import (
    MAX_LEGEND_ENTRIES,
    build_panels,
    format_index,
    group_marks,
    list_marks,
    split_values,
)
from rack.tools.recording.in_force import VisibleMessages
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, find_mailbox, list_signals
from rack.tools.report.stored import load_report
from rack.tools.scripting.moment import RecordedMoment

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame


def open_run(folder: str | Path) -> RecordedRun:
    """Open the run in a folder. Raises `Failure`."""
    return RecordedRun(Path(folder))


class RecordedRun:
    """A run that `rack run` or `rack record` has recorded.

    Attributes:
        folder: Folder of the run.
        signals: Mapping from name to signal, with every field of every mailbox. One number of a
            field can be looked up as well, as in `servo.status.position[2]`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._recording = Recording(folder)
        self._in_force = VisibleMessages(self._recording)
        self.signals = RecordedSignals(self._recording)

    def __repr__(self) -> str:
        end = self._recording.end_counts.get("outcome", {}).get("cause", "no outcome")
        rack = self._recording.layout.rack
        return f"<run {self.folder} of rack '{rack}': {end}, {len(self.signals)} signals>"

    def at(self, time_s: float) -> RecordedMoment:
        """Return the run at a simulated time in s. Raises `Failure` for a time outside the run."""
        tick = parse_tick(self._recording, str(time_s))
        return RecordedMoment(self._recording, self._in_force, tick)

    @cached_property
    def events(self) -> list[Event]:
        """Events of the run, oldest first. Empty in a recording by `rack record`."""
        recorded = self._recording.events
        return [Event(**event) for event in recorded if event["kind"] != "outcome"]

    @cached_property
    def report(self) -> Document:
        """Content of report.json. The file is updated first if it is missing or out of date."""
        return load_report(self.folder)

    def to_pandas(self, mailbox: str) -> DataFrame:
        """Return a table of all messages of a mailbox. See `RecordedSignal.to_pandas`."""
        box = find_mailbox(mailbox, self._recording.layout.mailboxes)
        return _build_table([self.signals[signal.name] for signal in list_signals(box)])


class RecordedSignals(dict[str, "RecordedSignal"]):
    """Signals of a run, keyed by name. An unknown name raises `Failure` with the nearest names."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._boxes = recording.layout.mailboxes
        for name, signal in Signal.build_by_name(self._boxes).items():
            self[name] = RecordedSignal(recording, signal)

    def __repr__(self) -> str:
        names = ", ".join([*self][:2])
        return f"<{len(self)} signals of {len(self._boxes)} mailboxes: {names}, ...>"

    def __missing__(self, name: str) -> RecordedSignal:
        return RecordedSignal(self._recording, Signal.parse(name, self._boxes))


class RecordedSignal:
    """A signal of a run, read on first use.

    Attributes:
        name: Name of the signal, as in `servo.status.position[2]`.
        unit: Unit. Empty for counts, names and text.
        meaning: Meaning of the field.
        shape: Shape of its value in one message.
    """

    def __init__(self, recording: Recording, signal: Signal) -> None:
        self._recording = recording
        self.signal = signal
        self.name = signal.name
        self.unit = signal.unit
        self.meaning = signal.spec.meaning
        self.shape = signal.shape[len(signal.index) :]

    def __repr__(self) -> str:
        properties = [self.unit] * bool(self.unit) + [f"shape {self.shape}"] * bool(self.shape)
        return f"<signal {', '.join([self.name, *properties])}: {self.meaning}>"

    @cached_property
    def values(self) -> np.ndarray:
        """Values in all messages, (messages, *shape), in `unit`. States are given as numbers."""
        signal = self.signal
        return signal.select_part(self._recording.read_signal(signal.mailbox, signal.label))

    @cached_property
    def ticks(self) -> np.ndarray:
        """Ticks at which the messages were released, (messages,)."""
        return self._recording.read_signal(self.signal.mailbox, "tick")

    @property
    def time_s(self) -> np.ndarray:
        """Simulated times in s at which the messages were released, (messages,)."""
        return self.ticks * (self._recording.layout.clock_ns * 1e-9)

    def to_pandas(self) -> DataFrame:
        """Return a table with a row for each message, indexed by time_s.

        Its columns are the tick and each number of the signal. States are given by name. Raises
        `Failure` without pandas.
        """
        return _build_table([self])

    def plot(self, axes: Axes | None = None) -> Axes:
        """Plot the signal over simulated time, with the marks of `rack plot`.

        Args:
            axes: Axes of matplotlib to draw on. None for a new figure.

        Returns:
            The axes.

        Raises:
            Failure: The signal is a text, or matplotlib is missing.
        """
        all_series = split_values(self.signal, self.time_s, self.values)
        if not can_draw():
            raise Failure(NO_PICTURES)
        from matplotlib import pyplot

        from rack.tools.plots.figure import draw_panel

        axes = axes or pyplot.figure(layout="constrained").add_subplot()
        (panel,) = build_panels(all_series)
        end_s = max(self.time_s, default=0.0)
        marks = draw_panel(axes, panel, group_marks(list_marks(self._recording)), end_s)
        axes.set_xlabel("simulated time, s")
        if 1 < len(axes.get_lines()) + len(marks) <= MAX_LEGEND_ENTRIES:
            axes.legend(fontsize="small")
        return axes


def _build_table(signals: Sequence[RecordedSignal]) -> DataFrame:
    """Return the signals of one mailbox as a table. Raises `Failure` without pandas."""
    try:
        from pandas import DataFrame, Index
    except ImportError:
        raise Failure("tables need pandas: pip install 'nasrem-rack[notebook]'") from None
    columns = {"tick": signals[0].ticks}
    for signal in signals:
        values = signal.signal.replace_numbers(signal.values)
        for index in np.ndindex(values.shape[1:]):
            columns[f"{signal.name}{format_index(index)}"] = values[(slice(None), *index)]
    return DataFrame(columns, index=Index(signals[0].time_s, name="time_s"))
