"""The three timelines of a recording: simulated time, tick, wall clock."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

Ints = NDArray[np.int64]

SIM_TIME, TICK, WALL = "sim_time", "tick", "wall"
KEPT = 4096
"""Pairs of tick and time that are kept to place what has a tick and no time stamp."""


class Moment(NamedTuple):
    """One moment: simulated time since tick 0, and the wall clock."""

    sim_time: np.timedelta64
    wall: np.datetime64


class Timelines:
    """Turns ticks and CLOCK_MONOTONIC stamps into time columns; all integers, ns."""

    def __init__(self, clock_ns: int) -> None:
        self.clock_ns = clock_ns
        # One offset for the whole recording: a clock that is set meanwhile must not fold the timeline.
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._ticks: Ints = np.zeros(1, dtype=np.int64)
        self._stamps: Ints = np.array([time.monotonic_ns()])

    def columns(self, ticks: Ints, stamps_ns: Ints, within_ns: Ints | int = 0) -> list[rr.TimeColumn]:
        """Return the columns of rows released at `ticks`, `within_ns` of simulated time later, stamped `stamps_ns`."""
        return [
            rr.TimeColumn(SIM_TIME, duration=(ticks * self.clock_ns + within_ns).astype("timedelta64[ns]")),
            rr.TimeColumn(TICK, sequence=ticks),
            rr.TimeColumn(WALL, timestamp=(stamps_ns + self._offset_ns).astype("datetime64[ns]")),
        ]

    def moment(self, tick: int, stamp_ns: int) -> Moment:
        """Return one moment on the timelines."""
        return Moment(np.timedelta64(tick * self.clock_ns, "ns"), np.datetime64(stamp_ns + self._offset_ns, "ns"))

    def learn(self, ticks: Ints, stamps_ns: Ints) -> None:
        """Take down when ticks happened; both are sorted."""
        new = ticks > self._ticks[-1]
        self._ticks = np.concatenate((self._ticks, ticks[new]))[-KEPT:]
        self._stamps = np.concatenate((self._stamps, stamps_ns[new]))[-KEPT:]

    def stamps_of(self, ticks: Ints) -> Ints:
        """Return about when ticks happened, CLOCK_MONOTONIC, ns."""
        # From the newest on, so that nothing is lost to the 53 bits of a float.
        last = self._stamps[-1]
        return np.asarray(last + np.interp(ticks, self._ticks, self._stamps - last).astype(np.int64))

    def monotonic(self, time_ns: int) -> int:
        """Return a CLOCK_REALTIME stamp as CLOCK_MONOTONIC."""
        return time_ns - self._offset_ns
