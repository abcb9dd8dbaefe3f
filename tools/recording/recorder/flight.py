"""The flight recorder, which deletes old parts of a recording that are not near an occasion.

Occasions are alarms, missed or skipped cycles, and the beginning and end of each hold.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.recording.occasions import Occasions, Retention
from rack.tools.recording.run_files import Tally
from rack.tools.recording.spool import Spool, StretchHead

STRETCH_S = 1.0
"""Simulated duration of a stretch."""


class FlightRecorder:
    """Divides the spool of a recorder into stretches, and deletes stretches that are not needed.

    A stretch is a file with the rows of about one second. It is needed if it is near an occasion:
    an alarm, a missed or skipped cycle, or the beginning or end of a hold. All stretches of an
    earlier, killed recorder are kept, because its occasions are unknown. They are few, because a
    rack restarts its recorder at most three times.
    """

    def __init__(self, segment: Segment, retention: Retention, spool: Spool, tally: Tally) -> None:
        self._retention = retention
        self._spool = spool
        self._tally = tally
        self._words = segment.words
        self._occasions = Occasions(segment)
        self._length = round(STRETCH_S * 1e9 / segment.layout.clock_ns)
        # Finished stretches that are not near any occasion found so far, with their last ticks.
        self._sealed: deque[tuple[Path, int]] = deque()
        self._kept_until = -1
        self._began = 0
        if tally.stretch_number:
            # Rows may have been lost while no recorder was running.
            self._keep_around(self._words[System.TICK])
        self._path = self._begin_stretch(self._began, self._began)

    def keep_occasions(self, ring: str, rows: np.ndarray, lost: int) -> None:
        """Keep the stretches around all occasions in new rows of a ring.

        Args:
            ring: Name of the ring.
            rows: The rows, shape (rows,).
            lost: Number of rows lost before these rows. A loss counts as an occasion, because the
                content of the lost rows is unknown.
        """
        loss_ticks = [self._words[System.TICK]] if lost else []
        for tick in (*loss_ticks, *self._occasions.find_occasion_ticks(ring, rows)):
            self._keep_around(tick)

    def advance_to(self, tick: int) -> None:
        """Begin a new stretch if the current one is long enough, and delete old ones.

        Stretches near an occasion are not deleted.

        Call this when all rows written before `tick` are in the spool.
        """
        for alarm_tick in self._occasions.find_alarm_ticks():
            self._keep_around(alarm_tick)
        if tick - self._began < self._length:
            return
        # Rows of cycles that ended since `tick` may be in either stretch.
        next_tick = self._words[System.TICK] + 1
        path = self._begin_stretch(next_tick, tick)
        if self._began > self._kept_until:
            self._sealed.append((self._path, next_tick))
        self._path = path
        self._began = tick
        while self._sealed and self._sealed[0][1] < tick - self._retention.keep:
            self._sealed.popleft()[0].unlink(missing_ok=True)

    def close(self) -> None:
        """Finish the last stretch, and add an empty one whose head contains the final counts."""
        end = self._words[System.TICK] + 1
        self._begin_stretch(end, end)
        self._spool.close(end)

    def _begin_stretch(self, begin: int, end: int) -> Path:
        """Begin a new stretch.

        Args:
            begin: First tick of the new stretch.
            end: Tick at which the current stretch ends.

        Returns:
            Path of the new stretch.
        """
        tally = self._tally
        stretch = StretchHead(tally.stretch_number + 1, begin, dict(tally.taken), dict(tally.rows))
        tally.begin_stretch(stretch)
        return self._spool.begin_stretch(stretch, end)

    def _keep_around(self, tick: int) -> None:
        """Protect the stretches around an occasion at `tick` from deletion."""
        window = self._retention.find_window(tick)
        self._kept_until = max(self._kept_until, window.last)
        while self._sealed and self._sealed[-1][1] >= window.first:
            self._sealed.pop()
