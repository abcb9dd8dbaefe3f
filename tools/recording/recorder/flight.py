"""The flight recorder: a recorder whose spool is in stretches, and forgets those that are old and
near no occasion.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.recording.occasions import Occasions, Retention
from rack.tools.recording.run_files import Tally
from rack.tools.recording.spool import Spool, StretchHead

STRETCH_S = 1.0
"""Simulated time in a stretch."""


class Sealed(NamedTuple):
    """A stretch that is finished, and near no occasion so far: its file, and its last tick."""

    path: Path
    last: int


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
        self._kept_until = -1
        self._began = 0
        if tally.number:
            # The rings hold what another recorder can no longer take.
            self._mark(self._words[System.TICK])
        self._path = self._begin(self._began, self._began)

    def look(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Look for occasions in rows of a ring, before which some were lost: nobody knows what was
        in those.
        """
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
        if self._began > self._kept_until:
            self._sealed.append(Sealed(self._path, next_tick))
        self._path = path
        self._began = tick
        while self._sealed and self._sealed[0].last < tick - self._retention.keep:
            self._sealed.popleft().path.unlink(missing_ok=True)

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
        """Keep the stretches around an occasion for good."""
        window = self._retention.around(tick)
        self._kept_until = max(self._kept_until, window.last)
        while self._sealed and self._sealed[-1].last >= window.first:
            self._sealed.pop()
