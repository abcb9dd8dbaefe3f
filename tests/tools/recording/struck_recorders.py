"""Displays that disturb the recorder of a run, and helpers that read its recording."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config import RackConfig
from rack.boards.events import Event
from rack.tools.monitor.display import Display
from rack.tools.monitor.snapshot import Snapshot
from rack.tools.recording.file_names import SPOOL
from rack.tools.recording.recording import Recording
from tests.warm import programs

FIRST_BLOCK = 400
"""Ticks after which there is something on disk."""
LONG_S = 12.0
"""Simulated time that the recorder does not outrun."""


class Keeping(Display):
    """Keeps the texts of events."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def show_event(self, event: Event) -> None:
        """Keep the text."""
        self.texts.append(event.text)


class AtTick(Display):
    """Strikes the recorder `times` times after the run has reached a tick.

    By default it sends a signal.
    """

    period_s = 0.05

    def __init__(self, number: signal.Signals, tick: int = FIRST_BLOCK, times: int = 1) -> None:
        self._number, self._tick, self._times = number, tick, times
        self.struck: list[int] = []

    def show(self, snapshot: Snapshot) -> None:
        """Look at the tick."""
        if snapshot.tick > self._tick and len(self.struck) < self._times:
            for pid in programs("rack.tools.recording.recorder"):
                if pid not in self.struck:
                    self.struck.append(pid)
                    self.strike(pid)

    def strike(self, pid: int) -> None:
        """Send the signal."""
        os.kill(pid, self._number)


class Held(AtTick):
    """Strikes while a rack in lockstep, launched with `step`, is held at the tick.

    The run cannot end before the strike, however late a busy machine lets the display look.
    Afterwards the rack continues. With `is_ready` it also waits until that returns True, such as
    for a file that the recorder makes later.
    """

    def __init__(
        self,
        rack: str,
        number: signal.Signals,
        tick: int = FIRST_BLOCK,
        times: int = 1,
        is_ready: Callable[[], bool] = lambda: True,
    ) -> None:
        super().__init__(number, -1, times=times)
        self._rack, self._hold_at, self._is_ready = rack, tick + 1, is_ready

    def show(self, snapshot: Snapshot) -> None:
        """Let the rack run to the tick, and strike there."""
        with closing(Segment.attach(self._rack)) as segment:
            if segment.words[System.HELD] == self._hold_at and self._is_ready():
                super().show(snapshot)
            is_done = len(self.struck) == self._times
            segment.words[System.HOLD_AT] = 0 if is_done else self._hold_at


def has_spooled(run: Path, frames: int) -> bool:
    """Check whether the recorder has written this many frames of rows."""
    spool = run / SPOOL
    return spool.is_file() and spool.read_bytes().count(b"\n") > frames


class FillingDisk(AtTick):
    """Limits the size of the recorder's files from some tick on, as if the disk were full."""

    def __init__(self) -> None:
        super().__init__(signal.SIGKILL)
        self.full_at = 0.0

    def strike(self, pid: int) -> None:
        """Fill the disk."""
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096, 4096))
        self.full_at = time.monotonic()


def notes_of(recording: Recording) -> list[str]:
    return [event["text"] for event in recording.events if event["kind"] == "recorder"]


def counts(recording: Recording) -> dict[str, int]:
    """Return the rows of every task and every mailbox."""
    rows = {task: len(cycles) for task, cycles in recording.cycles.items()}
    return rows | {name: len(recording.read_signal(name, "serial")) for name in recording.mailboxes}


def realtime(config: RackConfig, speed: float = 1.0) -> RackConfig:
    changes = {"mode": "realtime", "speed": speed}
    return config.model_copy(update={"clock": config.clock.model_copy(update=changes)})


class EndingView:
    """A view whose library ends the recorder's process when it is closed, as if memory ran out."""

    def __init__(self, segment: Segment, folder: Path, port: int | None) -> None:
        pass

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Take nothing."""

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Take nothing."""

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """End the process."""
        os._exit(70)
