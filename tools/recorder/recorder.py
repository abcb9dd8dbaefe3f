"""The recorder: follows a rack by its rings, from the host side, and costs its boards nothing."""

from __future__ import annotations

import os
import select
from pathlib import Path
from types import TracebackType
from typing import Self

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.process import is_alive
from rack.backplane.segment import Segment
from rack.backplane.trace import trace_ring
from rack.backplane.words import Run, System
from rack.tools.recorder.files import RunFiles
from rack.tools.recorder.side_sink import Sink
from rack.tools.recorder.spool import Frame, Spool
from rack.tools.recorder.steal import StealMeter

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
        # The spool first: it is refused where another recorder is at work, whose files stay as they are.
        self._spool = Spool(folder, layout)
        self._files = RunFiles(folder, layout)
        self._spool.resume(self._files.add)
        traces = {task.name: trace_ring(segment, task.name) for task in layout.tasks}
        mailboxes = {mailbox.name: MailboxRing(segment, mailbox.name) for mailbox in layout.mailboxes}
        self._rings = traces | mailboxes
        for name, taken in self._files.taken.items():
            self._rings[name].resume(taken)
        # In lockstep nothing is late.
        self._steal = None if self._words[System.LOCKSTEP] else StealMeter()
        self._is_stopped = False
        follower = self._words[System.FOLLOWER_PID]
        self._is_follower = follower == os.getpid() or not is_alive(follower)
        self._follow_from(self._words[System.TICK])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def drain(self) -> None:
        """Take over everything written since the last call."""
        tick = self._words[System.TICK]
        for name, ring in self._rings.items():
            rows, lost = ring.drain()
            self._spool.add(name, rows, lost)
            self._files.add(Frame(name, rows, lost))
            if self._beside is not None and name in self._files.tasks:
                self._beside.add_cycles(name, rows)
            elif self._beside is not None:
                self._beside.add_signals(name, rows)
        self._spool.flush()
        if self._steal is not None:
            self._steal.look()
        if self._beside is not None:
            self._beside.advance(tick, self._files.lost)
        self._follow_from(tick)

    def _follow_from(self, tick: int) -> None:
        """In lockstep, tell the clock how far the recording is; it may have let a follower go that was held up."""
        if self._is_follower:
            self._words[System.FOLLOWER_TICK] = tick
            self._words[System.FOLLOWER_PID] = os.getpid()

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
        self._spool.flush(now=True)
        self._files.close([] if self._steal is None else self._steal.stolen)
        self._spool.remove()
        if self._beside is not None:
            self._beside.close(self._words[System.TICK] + 1, self._files.lost)
