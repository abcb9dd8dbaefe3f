"""The flight recorder, which deletes old parts of a recording that are not near an occasion.

An occasion is an event around which the recording is kept: an alarm, a missed or skipped cycle, or
the beginning or end of a hold.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, open_alarm_ring
from rack.backplane.words import System
from rack.boards.config.record import RecordConfig
from rack.boards.timing.trace_times import count_skipped_releases, find_missed_cycles
from rack.tools.recording.run_files import Tally
from rack.tools.recording.spool import Spool, StretchHead

ORDINARY_ALARMS = (Alarm.COMMANDED,)
"""Alarms that are not occasions. All other alarms are, for example faults and detections."""


STRETCH_S = 1.0
"""Simulated duration of a stretch."""


class TickRange(NamedTuple):
    """Ticks from `first` to `last`, inclusive."""

    first: int
    last: int


class Retention(NamedTuple):
    """The settings of a flight recorder in `[record]`, converted to ticks.

    Attributes:
        keep: Number of newest ticks, which are always kept.
        before: Number of ticks that are kept before each occasion: an alarm, a missed or skipped
            cycle, or the beginning or end of a hold.
        after: Number of ticks that are kept after each occasion.
    """

    keep: int
    before: int
    after: int

    @classmethod
    def from_config(cls, segment: Segment) -> Self | None:
        """Read the settings from a rack's config. Returns None if its recorder keeps everything."""
        config = RecordConfig.model_validate(load_toml(segment.config).get("record", {}))
        if config.keep is None:
            return None
        return cls(*map(segment.layout.to_ticks, (config.keep, config.before, config.after)))

    def find_window(self, tick: int) -> TickRange:
        """Return the ticks that are kept around an occasion at `tick`."""
        return TickRange(max(0, tick - self.before), tick + self.after)

    def find_missing_windows(
        self, segment: Segment, kept: Sequence[tuple[int, int]], ticks: int
    ) -> list[TickRange]:
        """Find the ranges of ticks that should have been kept but were not kept completely.

        These are the newest ticks of the run, and the ticks around each alarm.

        Args:
            segment: Segment of the rack, whose alarm rings still contain the last alarms.
            kept: Ticks that were kept, as ranges [first, end).
            ticks: Length of the run in ticks.
        """
        windows = [
            TickRange(max(0, ticks - self.keep), ticks - 1),
            *map(self.find_window, Occasions(segment).find_alarm_ticks()),
        ]
        clipped = [TickRange(first, min(last, ticks - 1)) for first, last in windows]
        return [
            window
            for window in clipped
            if not any(first <= window.first and window.last < end for first, end in kept)
        ]


class Occasions:
    """Finds occasions, the ticks around which a flight recorder keeps the recording.

    Occasions are alarms, missed or skipped cycles, and the beginning and end of each hold.
    """

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        owners = (CLOCK, *(task.name for task in layout.tasks))
        self._alarms = [open_alarm_ring(segment, owner) for owner in owners]
        self._tasks = {task.name for task in layout.tasks}
        self._holding = {
            box.name: False
            for box in layout.timed
            if box.name.endswith(".status") and any(field.name == "state" for field in box.fields)
        }

    def find_alarm_ticks(self) -> Iterator[int]:
        """Yield the ticks of alarms since the last call, except `ORDINARY_ALARMS`.

        The first call also yields earlier alarms that the alarm rings still contain.
        """
        for ring in self._alarms:
            rows = ring.read_new_rows().rows
            yield from rows["tick"][~np.isin(rows["code"], ORDINARY_ALARMS)].tolist()

    def find_occasion_ticks(self, ring: str, rows: np.ndarray) -> Iterator[int]:
        """Yield the ticks of occasions in new rows of a ring.

        Args:
            ring: Name of the task or mailbox.
            rows: Its rows since the last call, shape (rows,).
        """
        ticks = rows["tick"]
        if ring in self._tasks:
            yield from ticks[find_missed_cycles(rows) | (count_skipped_releases(rows) > 0)].tolist()
        elif ring in self._holding and len(rows):
            holding = rows["message"]["state"] == State.HOLDING
            held_before = np.concatenate(([self._holding[ring]], holding[:-1]))
            self._holding[ring] = bool(holding[-1])
            yield from ticks[holding != held_before].tolist()


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
        self._length = segment.layout.to_ticks(STRETCH_S)
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
