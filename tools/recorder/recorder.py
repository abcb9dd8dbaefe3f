"""The recorder: follows a rack by its rings, from the host side, and costs its boards nothing."""

from __future__ import annotations

import os
import select
from pathlib import Path
from types import TracebackType
from typing import Self

from backplane.process import is_alive
from backplane.ring import mailbox_ring
from backplane.segment import Segment
from backplane.trace import trace_ring
from backplane.words import Run, System
from tools.recorder.cycles import CyclesFile
from tools.recorder.side_sink import Sink
from tools.recorder.signals import SignalsFile

REALTIME_S = 0.05
LOCKSTEP_S = 0.005
"""How often rings are drained. They hold two seconds; lockstep waits for its recorder and runs faster than time."""


class Recorder:
    """Records one rack into `folder`. Use it as a context: leaving it finishes the files.

    The first recorder of a rack in lockstep is its follower: the clock waits for it. `beside` takes the same rows.
    """

    def __init__(self, segment: Segment, folder: Path, beside: Sink | None = None) -> None:
        layout = segment.layout
        self._beside = beside
        self._segment, self._words = segment, segment.words
        self._traces = {task.name: trace_ring(segment, task.name) for task in layout.tasks}
        self._mailboxes = {mailbox.name: mailbox_ring(segment, mailbox.name) for mailbox in layout.mailboxes}
        self._cycles = CyclesFile(folder / "cycles.parquet")
        self._signals = SignalsFile(folder / "signals.parquet", layout)
        self._is_stopped = False
        self._lost = dict.fromkeys([*self._traces, *self._mailboxes], 0)
        self._is_follower = not is_alive(self._words[System.FOLLOWER_PID])
        if self._is_follower:
            self._words[System.FOLLOWER_TICK] = self._words[System.TICK]
            self._words[System.FOLLOWER_PID] = os.getpid()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def drain(self) -> None:
        """Take over everything written since the last call."""
        tick = self._words[System.TICK]
        for task, ring in self._traces.items():
            rows, lost = ring.drain()
            self._cycles.add(task, rows)
            self._lost[task] += lost
            if self._beside is not None:
                self._beside.add_cycles(task, rows)
        for mailbox, ring in self._mailboxes.items():
            rows, lost = ring.drain()
            self._signals.add(mailbox, rows)
            self._lost[mailbox] += lost
            if self._beside is not None:
                self._beside.add_signals(mailbox, rows)
        if self._beside is not None:
            self._beside.advance(tick, self._lost)
        if self._is_follower:
            self._words[System.FOLLOWER_TICK] = tick

    def follow(self, until: int | None = None) -> None:
        """Record until the run is over; with a descriptor `until`, until that can be read or its other end is gone."""
        period_s = LOCKSTEP_S if self._words[System.LOCKSTEP] else REALTIME_S
        watched = [] if until is None else [until]
        while not select.select(watched, [], [], period_s)[0]:
            self.drain()
            over = self._words[System.STATE] == Run.STOPPED or not self._segment.launcher_is_alive
            if self._is_stopped or (until is None and over):
                break
        self.drain()

    def stop(self) -> None:
        """Have `follow` return soon."""
        self._is_stopped = True

    def close(self) -> None:
        """Finish both files; the rack goes on without a follower."""
        if self._is_follower:
            self._words[System.FOLLOWER_PID] = 0
        self._cycles.close({task: self._lost[task] for task in self._traces})
        self._signals.close({mailbox: self._lost[mailbox] for mailbox in self._mailboxes})
        if self._beside is not None:
            self._beside.close(self._words[System.TICK] + 1, self._lost)
