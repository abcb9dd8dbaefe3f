"""The recorder, which reads the rings of a rack and writes them to the folder of the run.

It reads from the host side and never delays a board.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Protocol, Self

import numpy as np

from rack.backplane.process import is_alive, wait_readable
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config.layout import RETAINED_S
from rack.tools.console.answer import write_file
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.cores import UNMEASURED, CoreMeter
from rack.tools.recording.file_names import PUBLISHED
from rack.tools.recording.occasions import FlightRecorder, Retention
from rack.tools.recording.recorder.process import CHECK_PERIOD_S, IdleCounter
from rack.tools.recording.run_files import TABLE_PATTERNS, RunFiles, Tally
from rack.tools.recording.spool import Spool, open_rings

REALTIME_PERIOD_S = 0.05
LOCKSTEP_PERIOD_S = 0.005
"""Time between two drains of the rings, in real time and in lockstep.

The rings hold two seconds. A rack in lockstep may run faster than real time, and waits for its
recorder.
"""

HAND_OVER_S = 0.1
"""Longest time per pass for which waiting rows are passed on to a sink that was opened late.

Rows that boards write in that time reach the spool only in the next pass.
"""
OPENING_TIMEOUT_S = 120.0
"""Longest time that a finishing recorder waits for its sink to open.

On a busy machine, loading the viewer's library alone may take a minute.
"""
MAX_OPENING_CHECKS = 25
"""Number of consecutive idle checks, 0.2 s apart, after which opening the sink counts as hung.

The viewer's library waits forever for a file that cannot be written.
"""
HURRIED_TIMEOUT_S = 0.5
"""Longest time that a hurried recorder waits for its sink to open.

An interrupted run must end within 2 s.
"""


class Sink(Protocol):
    """Receives the rows that a recorder reads from the rings, for example to show them."""

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Receive rows of a ring.

        Args:
            ring: Name of the task or mailbox.
            rows: Its trace records or rows with messages, shape (rows,).
        """

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Process the rows received so far.

        Args:
            tick: Tick before which all rows have been received.
            lost: Number of lost rows of each ring.
        """

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Finish the output.

        Args:
            tick: Tick at which the run ended.
            lost: Number of lost rows of each ring.
        """


class SafeSink:
    """Protects the recorder from errors and delays of another sink, which writes the viewer's file.

    After its first error, which is reported through `tell`, the other sink is dropped and the
    recorder continues without it. Calls are queued, and passed on in `advance` when the rows are
    already in the spool. With `in_background` a thread opens the other sink, because its imports
    may take as long as a launch. Calls remain in the queue until the sink is open.
    """

    def __init__(
        self, opened: Callable[[], Sink], tell: Callable[[str], None], in_background: bool = False
    ) -> None:
        self._tell = tell
        self._sink: Sink | None = None
        # Keep a failed sink alive: dropping a stream whose file could not be written may make the
        # viewer's library wait forever.
        self._failed: Sink | None = None
        self._waiting: deque[Callable[[Sink], None]] = deque()
        self._late = 0  # number of calls still waiting from earlier passes
        # A daemon thread, so that a hurried process can exit without it.
        self._opening = Thread(
            target=self._call_guarded,
            args=(lambda: setattr(self, "_sink", opened()),),
            daemon=True,
        )
        self._opening.start()
        if not in_background:
            self._opening.join()
        self._patience_s = OPENING_TIMEOUT_S
        self._why_late = "the viewer's library has not opened it"

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Queue rows for the sink."""
        self._waiting.append(lambda sink: sink.add(ring, rows))

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Pass on the queued calls if the sink is open.

        If the sink was opened late, the older calls are spread over several passes.
        """
        counted = dict(lost)
        self._waiting.append(lambda sink: sink.advance(tick, counted))
        if not self._opening.is_alive():
            self._make_waiting_calls(time.monotonic() + HAND_OVER_S)
        self._late = len(self._waiting)

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Wait for the sink to open, pass on all queued calls and finish it.

        If the sink does not open in time, the user is told that the viewer's file is missing.
        """
        self._waiting.append(lambda sink: sink.close(tick, lost))
        until = time.monotonic() + self._patience_s
        idle = IdleCounter(os.getpid())
        while self._opening.is_alive() and time.monotonic() < until:
            self._opening.join(min(CHECK_PERIOD_S, self._patience_s))
            if idle.count_idle_checks() >= MAX_OPENING_CHECKS:
                break
        if self._opening.is_alive():
            self._tell(f"run.rrd is missing: {self._why_late}; 'rack replay' makes it")
        else:
            self._late = 0
            self._make_waiting_calls()

    def hurry(self) -> None:
        """Make `close` wait for the sink for at most `HURRIED_TIMEOUT_S`."""
        self._patience_s = HURRIED_TIMEOUT_S
        self._why_late = "the run was interrupted before the libraries of the viewer were loaded"

    def _make_waiting_calls(self, until: float = 0.0) -> None:
        """Pass queued calls on to the sink, oldest first.

        This passes on as many calls as were queued since the last pass, so that the queue never
        grows, and more if there is time before `until`. Calls to a failed sink are dropped.
        """
        while len(self._waiting) > self._late or (self._waiting and time.monotonic() < until):
            call = self._waiting.popleft()
            if (sink := self._sink) is not None:
                self._call_guarded(partial(call, sink))

    def _call_guarded(self, call: Callable[[], None]) -> None:
        """Run a function that opens or uses the sink. If it fails, drop the sink and report it."""
        try:
            call()
        except Exception as error:
            self._sink, self._failed = None, self._sink
            self._tell(f"run.rrd ends here: {' '.join(str(error).split()) or type(error).__name__}")


RISKED_DIVISOR = 4
"""Limit on the rows that are not yet in the spool's file, as a divisor of the rings' length.

A rack in lockstep may be ahead of the file by at most this fraction of the rings.
"""


class Recorder:
    """Records one rack into `folder`. A context manager that finishes the files on exit.

    `view` receives the same rows. The first recorder of a rack in lockstep becomes its follower,
    the process that the clock waits for.
    """

    def __init__(self, segment: Segment, folder: Path, view: Sink | None = None) -> None:
        layout = segment.layout
        self._folder = folder
        self._view = view
        self._words = segment.words
        # Open the spool first, since it fails if another recorder is running, whose files must
        # then not be touched.
        self._spool = Spool(folder, layout, segment.launch)
        write_file(folder / PUBLISHED, segment.published)
        Checksums(folder).store(PUBLISHED)
        retention = Retention.from_config(segment)
        self._rings = open_rings(segment)
        before = {name: ring.before for name, ring in self._rings.items()}
        self._files = None
        if retention is None:
            self._files = RunFiles(folder, layout, segment.launch, before=before)
        self._tally = self._files or Tally(layout, before)
        for part in self._spool.read_rest():
            self._tally.count_part(part)
        self._flight = (
            None
            if retention is None
            else FlightRecorder(segment, retention, self._spool, self._tally)
        )
        for name, taken in self._tally.taken.items():
            self._rings[name].taken = taken
        # In lockstep the machine cannot cause a deadline miss.
        self._cores = None if self._words[System.LOCKSTEP] else CoreMeter()
        follower = self._words[System.FOLLOWER_PID]
        # The clock cannot wait for a process in another PID namespace, which it cannot see.
        is_visible = bool(segment.launcher)
        is_awaited = is_visible and follower == os.getpid()
        self._is_follower = is_awaited or (is_visible and not is_alive(follower))
        # All rows before this tick are in the spool's file. A recorder that the clock waits for
        # continues where the previous recorder stopped, even if that one died before it wrote a
        # row. Any other recorder begins at the current tick.
        self._safe_tick = self._words[System.FOLLOWER_TICK if is_awaited else System.TICK]
        self._most_at_risk = layout.to_ticks(RETAINED_S) // RISKED_DIVISOR
        self._report_progress()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        if kind is None:
            self.close()
        else:
            # The parquet files may be incomplete. The next recorder, or `rebuild_files`, builds
            # them from the spool.
            self._spool.close()

    def drain_rings(self) -> None:
        """Record all rows that were written to the rings since the last call."""
        tick = self._words[System.TICK]
        for name, ring in self._rings.items():
            rows, lost = ring.read_new_rows()
            self._spool.add_rows(name, rows, lost)
            self._tally.add_rows(name, rows, lost)
            if self._flight is not None:
                self._flight.keep_occasions(name, rows, lost)
            if self._view is not None:
                self._view.add(name, rows)
        if self._is_follower:
            self._words[System.FOLLOWER_DRAINED] = tick
        # If the recorder is killed, rows that are not in the spool's file must still be in the
        # rings, so a rack in lockstep must not run far ahead of the file.
        is_late = self._is_follower and tick - self._safe_tick >= self._most_at_risk
        if self._spool.flush(now=is_late):
            self._safe_tick = tick
        if self._flight is not None:
            self._flight.advance_to(tick)
        if self._cores is not None:
            self._cores.read_counters()
        if self._view is not None:
            self._view.advance(tick, self._tally.lost)
        self._report_progress()

    def _report_progress(self) -> None:
        """Tell the clock of a rack in lockstep up to which tick all rows are in the spool's file.

        The recorder also becomes the follower again if the clock had stopped waiting for it.
        """
        if self._is_follower:
            self._words[System.FOLLOWER_TICK] = self._safe_tick
            self._words[System.FOLLOWER_PID] = os.getpid()

    def record_until(self, until: int) -> None:
        """Record until the file descriptor `until` is readable or closed."""
        period_s = LOCKSTEP_PERIOD_S if self._words[System.LOCKSTEP] else REALTIME_PERIOD_S
        while not wait_readable(until, period_s):
            self.drain_rings()
        self.drain_rings()

    def close(self) -> None:
        """Stop the clock from waiting for this recorder, and finish the files."""
        if self._is_follower:
            self._words[System.FOLLOWER_PID] = 0
        if self._flight is not None:
            self._flight.close()
        if self._files is not None:
            self._spool.flush(now=True)
            self._files.close(UNMEASURED if self._cores is None else self._cores.build_record())
            Checksums(self._folder).store(*TABLE_PATTERNS)
            # The parquet files are complete.
            self._spool.path.unlink()
            self._spool.close()
        if self._view is not None:
            self._view.close(self._words[System.TICK] + 1, self._tally.lost)
            Checksums(self._folder).store("*.rrd")
