"""A second taker of what the recorder drains, which may fail without harm to the first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np


class Sink(Protocol):
    """Takes what a recorder drains."""

    def add_cycles(self, task: str, rows: np.ndarray) -> None:
        """Take trace records of a task, shape (rows,)."""

    def add_signals(self, mailbox: str, rows: np.ndarray) -> None:
        """Take rows of a mailbox's ring, shape (rows,)."""

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Take note that everything before `tick` has been taken; `lost` counts lost rows by ring."""

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Finish."""


class SideSink:
    """Wraps a sink: its first error, whatever it is, ends it and is told once by `tell`; the recorder goes on."""

    def __init__(self, opened: Callable[[], Sink], tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._sink: Sink | None = None
        self._guarded(lambda: setattr(self, "_sink", opened()))

    def add_cycles(self, task: str, rows: np.ndarray) -> None:
        """Hand trace records on."""
        if (sink := self._sink) is not None:
            self._guarded(lambda: sink.add_cycles(task, rows))

    def add_signals(self, mailbox: str, rows: np.ndarray) -> None:
        """Hand messages on."""
        if (sink := self._sink) is not None:
            self._guarded(lambda: sink.add_signals(mailbox, rows))

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Hand the tick on."""
        if (sink := self._sink) is not None:
            self._guarded(lambda: sink.advance(tick, lost))

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Have it finish."""
        if (sink := self._sink) is not None:
            self._guarded(lambda: sink.close(tick, lost))

    def _guarded(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:
            self._sink = None
            self._tell(f"run.rrd ends here: {' '.join(str(error).split()) or type(error).__name__}")
