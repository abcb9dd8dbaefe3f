"""What a flight recorder keeps for good: which occasions count, and the ticks around each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, alarm_ring
from rack.boards.config.record import RecordConfig
from rack.boards.timing.trace_times import is_missed, skipped

ORDINARY = (Alarm.COMMANDED,)
"""Alarms of an ordinary run. All others count: faults, detections, brakes, restarts."""


class TickRange(NamedTuple):
    """Ticks from `first` to `last`."""

    first: int
    last: int


class Retention(NamedTuple):
    """What `[record]` wants to be kept, in ticks."""

    keep: int
    before: int
    after: int

    @classmethod
    def of(cls, segment: Segment) -> Self | None:
        """Return it for a rack; None: everything is kept."""
        config = RecordConfig.model_validate(load_toml(segment.config).get("record", {}))
        if config.keep is None:
            return None
        spans_s = (config.keep, config.before, config.after)
        return cls(*(round(span_s * 1e9 / segment.layout.clock_ns) for span_s in spans_s))

    def around(self, tick: int) -> TickRange:
        """Return what is kept around an occasion."""
        return TickRange(max(0, tick - self.before), tick + self.after)

    def absent(
        self, segment: Segment, kept: Sequence[tuple[int, int]], ticks: int
    ) -> list[TickRange]:
        """Return what had to be kept of a run of `ticks`, as far as its alarm rings still say, and
        is not within the ticks `kept`, [first, end).
        """
        occasions = Occasions(segment).alarms()
        wanted = [TickRange(max(0, ticks - self.keep), ticks - 1), *map(self.around, occasions)]
        clipped = [TickRange(first, min(last, ticks - 1)) for first, last in wanted]
        return [
            window
            for window in clipped
            if not any(first <= window.first and window.last < end for first, end in kept)
        ]


class Occasions:
    """Finds the ticks of occasions: alarms, cycles missed or skipped, holds that begin or end."""

    def __init__(self, segment: Segment) -> None:
        layout = segment.layout
        owners = (CLOCK, *(task.name for task in layout.tasks))
        self._alarms = [alarm_ring(segment, owner) for owner in owners]
        self._tasks = {task.name for task in layout.tasks}
        self._holding = {
            box.name: False
            for box in layout.timed
            if box.name.endswith(".status") and any(field.name == "state" for field in box.fields)
        }

    def alarms(self) -> Iterator[int]:
        """Yield those of the alarms since the last call; of the first one, all that are left."""
        for ring in self._alarms:
            rows = ring.drain().rows
            yield from rows["tick"][~np.isin(rows["code"], ORDINARY)].tolist()

    def within(self, ring: str, rows: np.ndarray) -> Iterator[int]:
        """Yield those in rows of a ring."""
        ticks = rows["tick"]
        if ring in self._tasks:
            yield from ticks[is_missed(rows) | (skipped(rows) > 0)].tolist()
        elif ring in self._holding and len(rows):
            holding = rows["message"]["state"] == State.HOLDING
            before = np.concatenate(([self._holding[ring]], holding[:-1]))
            self._holding[ring] = bool(holding[-1])
            yield from ticks[holding != before].tolist()
