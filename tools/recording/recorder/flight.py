"""The flight recorder: a recorder whose spool is in stretches, and forgets those that are old and
near no occasion."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.recording.occasions import Occasions, Retention, TickRange
from rack.tools.recording.run_files import Tally
from rack.tools.recording.spool import Spool, StretchHead

STRETCH_S = 1.0
"""Simulated time in a stretch."""


class Sealed(NamedTuple):
    """A stretch that is finished: its file, and between which ticks its rows are, at the most."""

    path: Path
    ticks: TickRange


class FlightRecorder:
    """Divides what a recorder spools into stretches, and removes some of them.

    What a recorder that was killed has left stays: which occasions it saw is not known. A rack
    restarts its recorder three times at the most.
    """

    def __init__(self, segment: Segment, retention: Retention, spool: Spool, tally: Tally) -> None:
        self._retention = retention
        self._spool = spool
        self._tally = tally
        self._words = segment.words
        self._occasions = Occasions(segment)
        self._length = round(STRETCH_S * 1e9 / segment.layout.clock_ns)
        self._sealed: deque[Sealed] = deque()
        self._windows: list[TickRange] = []
        self._began = 0
        if tally.number:
            # The rings hold what another recorder can no longer take.
            self._mark(self._words[System.TICK])
        self._path = self._begin(self._began, self._began)

    def look(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Look for occasions in rows of a ring, before which some were lost: nobody knows what was
        in those."""
        found = [self._words[System.TICK]] if lost else []
        for tick in (*found, *self._occasions.within(ring, rows)):
            self._mark(tick)

    def advance(self, tick: int) -> None:
        """Go on after everything before a tick has been added to the spool."""
        for at in self._occasions.alarms():
            self._mark(at)
        if tick - self._began < self._length:
            return
        # The rows of what has begun meanwhile may be in either of the two.
        next_tick = self._words[System.TICK] + 1
        path = self._begin(next_tick, tick)
        self._sealed.append(Sealed(self._path, TickRange(self._began, next_tick)))
        self._path = path
        self._began = tick
        self._forget(tick - self._retention.keep)

    def close(self) -> None:
        """Finish the last stretch. An empty one follows, which says what was taken in all."""
        end = self._words[System.TICK] + 1
        self._begin(end, end)
        self._spool.close(end)

    def _begin(self, begin: int, end: int) -> Path:
        """Begin a stretch, and end the one before it."""
        tally = self._tally
        stretch = StretchHead(tally.number + 1, begin, dict(tally.taken), dict(tally.rows))
        tally.begin(stretch)
        return self._spool.divert(stretch, end)

    def _mark(self, tick: int) -> None:
        window = self._retention.around(tick)
        if self._windows and self._windows[-1].first <= window.first <= self._windows[-1].last:
            last = self._windows.pop()
            window = TickRange(last.first, max(last.last, window.last))
        self._windows.append(window)

    def _forget(self, before: int) -> None:
        """Remove the stretches that ended before a tick and are in no window."""
        sealed = self._sealed
        while sealed and sealed[0].ticks.last < before:
            path, (first, last) = sealed.popleft()
            if not any(one.first <= last and first <= one.last for one in self._windows):
                path.unlink(missing_ok=True)
        begins = sealed[0].ticks.first if sealed else self._began
        self._windows = [one for one in self._windows if one.last >= begins]
