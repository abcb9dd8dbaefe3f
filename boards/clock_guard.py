"""A fast board's look at the clock: ticks that were left out, and ticks that came late."""

from __future__ import annotations

from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.clock import SystemClock
from rack.backplane.layout import TaskSpec
from rack.backplane.segment import Segment
from rack.backplane.words import System

_TICK_NS, _TICK = int(System.TICK_NS), int(System.TICK)
QUIET_TICKS = 20
"""Punctual ticks that end an episode of late ones."""


class ClockGuard:
    """Compares, at every release, the clock's ticks with monotonic time.

    A release that is missing was left out by the clock when it has given out none of the ticks since: the clock
    stores when it gave out its newest one.
    """

    def __init__(self, segment: Segment, spec: TaskSpec, alarms: AlarmWriter) -> None:
        self._words = segment.words
        self._clock = SystemClock(segment)
        self._every = spec.every
        self._alarms = alarms
        self._late_ns = self._clock.period_ns // 2
        self._left_out = self._words[System.CLOCK_SKIPPED]
        self._quiet_from = 0

    def look(self, tick: int, skipped: int) -> None:
        """Look at the clock in the cycle released at `tick`, before which `skipped` releases passed."""
        words = self._words
        if skipped and words[System.CLOCK_SKIPPED] != self._left_out:
            left_out = words[System.CLOCK_SKIPPED] - self._left_out
            self._alarms.ring(tick, Alarm.CLOCK_SKIPPED, value=left_out, since=tick - left_out)
        self._left_out = words[System.CLOCK_SKIPPED]
        late_ns = words[_TICK_NS] - self._clock.time_of(tick)
        # Only now: the time is of this tick as long as the clock has not come to the next.
        if self._clock.is_lockstep or words[_TICK] != tick:
            return
        if late_ns > self._late_ns:
            if tick >= self._quiet_from:
                self._alarms.ring(tick, Alarm.CLOCK_LATE, value=late_ns)
            self._quiet_from = tick + QUIET_TICKS
