"""A recorded run, for a Python program: signals as arrays and as tables of pandas."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rack.boards.events import Event
from rack.tools.console.answer import Document, Failure
from rack.tools.live.continued import tick_in
from rack.tools.recording.in_force import InForce
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, mailbox_of, signals_of
from rack.tools.scripting.moment import RecordedMoment
from rack.tools.timing.analysis.stored import newest_report

if TYPE_CHECKING:
    from pandas import DataFrame


def open_run(folder: str | Path) -> RecordedRun:
    """Return the run in a folder. Raises `Failure`."""
    return RecordedRun(Path(folder))


class RecordedRun:
    """What `rack run` or `rack record` left in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._recording = Recording(folder)
        self._in_force = InForce(self._recording)
        self.signals = RecordedSignals(self._recording)
        """Every field of every mailbox; also found is a number of one, as in
        `servo.status.position[2]`."""

    def at(self, time_s: float) -> RecordedMoment:
        """Return the run at a simulated time, s. Raises `Failure` for one outside."""
        tick = tick_in(self._recording, str(time_s))
        return RecordedMoment(self._recording, self._in_force, tick)

    @cached_property
    def events(self) -> list[Event]:
        """What happened, oldest first; none in a recording by `rack record`."""
        found = self._recording.events
        return [Event(**event) for event in found if event["kind"] != "outcome"]

    @cached_property
    def report(self) -> Document:
        """The report, as in report.json, which is written if it is missing or older than the
        run."""
        return newest_report(self.folder)[0]

    def to_pandas(self, mailbox: str) -> DataFrame:
        """Return a table of all messages of a mailbox, as `RecordedSignal.to_pandas` does."""
        box = mailbox_of(mailbox, self._recording.layout.mailboxes)
        return _table([self.signals[signal.name] for signal in signals_of(box)])


class RecordedSignals(dict[str, "RecordedSignal"]):
    """The signals of a run by name. Raises `Failure` with the nearest names for an unknown one."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._boxes = recording.layout.mailboxes
        for name, signal in Signal.all(self._boxes).items():
            self[name] = RecordedSignal(recording, signal)

    def __missing__(self, name: str) -> RecordedSignal:
        return RecordedSignal(self._recording, Signal.of(name, self._boxes))


class RecordedSignal:
    """A signal of a run, read on first use; `unit` is empty for counts, names and text."""

    def __init__(self, recording: Recording, signal: Signal) -> None:
        self._recording = recording
        self.signal = signal
        self.unit = signal.unit

    @cached_property
    def values(self) -> np.ndarray:
        """Its value in every message, (messages, *shape), in `unit`; states are numbers."""
        signal = self.signal
        return signal.part(self._recording.signal(signal.mailbox, signal.label))

    @cached_property
    def ticks(self) -> np.ndarray:
        """The ticks at which the messages were released, (messages,)."""
        return self._recording.signal(self.signal.mailbox, "tick")

    @property
    def time_s(self) -> np.ndarray:
        """The same as simulated time, (messages,), s."""
        return self.ticks * (self._recording.layout.clock_ns * 1e-9)

    def to_pandas(self) -> DataFrame:
        """Return a table with a row a message, by time_s: the tick, and a column a number; states
        by name. Raises `Failure` without pandas."""
        return _table([self])


def _table(signals: Sequence[RecordedSignal]) -> DataFrame:
    """Return the signals of one mailbox as a table."""
    try:
        from pandas import DataFrame, Index
    except ImportError:
        raise Failure("tables need pandas: pip install 'nasrem-rack[notebook]'") from None
    columns = {"tick": signals[0].ticks}
    for one in signals:
        values = one.signal.named(one.values)
        for index in np.ndindex(values.shape[1:]):
            place = "".join(f"[{number}]" for number in index)
            columns[f"{one.signal.name}{place}"] = values[(slice(None), *index)]
    return DataFrame(columns, index=Index(signals[0].time_s, name="time_s"))
