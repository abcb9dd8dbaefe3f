"""Decides which ticks of a run a flight recorder keeps.

An occasion is an event around which the recording is kept: an alarm, a missed or skipped cycle, or
the beginning or end of a hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, open_alarm_ring
from rack.boards.config.record import RecordConfig
from rack.boards.timing.trace_times import count_skipped_releases, find_missed_cycles

ORDINARY_ALARMS = (Alarm.COMMANDED,)
"""Alarms that are not occasions. All other alarms are, for example faults and detections."""


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
        spans_s = (config.keep, config.before, config.after)
        return cls(*(round(span_s * 1e9 / segment.layout.clock_ns) for span_s in spans_s))

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
        occasions = Occasions(segment).find_alarm_ticks()
        windows = [
            TickRange(max(0, ticks - self.keep), ticks - 1),
            *map(self.find_window, occasions),
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
