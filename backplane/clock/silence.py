"""Detection of a stopped clock, by the tasks that wait for it. A late clock is not at fault."""

from __future__ import annotations

from time import monotonic_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.process import GONE, STOPPED, WAITING, state_of
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import System

CLOCK_TICKS = 2
"""Ticks after a missing release before the clock is checked."""
CLOCK_SILENT_S = 0.5
"""Time without a tick before the clock counts as stopped while its process waits: it cannot be
waiting for a tick."""


class SilentClock:
    """One task's check of a clock that makes no ticks."""

    def __init__(self, segment: Segment, alarms: AlarmWriter) -> None:
        self._words = segment.words
        self._clock = SystemClock(segment)
        self._alarms = alarms
        self._is_reported = False
        self._waited_at = -1

    def has_ticked(self) -> None:
        """Note a release: the next silence is a new one."""
        self._is_reported = False

    def patience_ns(self, expected: int) -> int:
        """Return how long to wait, ns, before the next check, if the next release is that of tick
        `expected`."""
        late = self._clock.time_of(expected + CLOCK_TICKS) - monotonic_ns()
        return late if late > 0 else CLOCK_TICKS * self._clock.period_ns

    def check(self) -> None:
        """Raise one alarm for a clock that makes no ticks: its process is stopped, dead, or silent
        for too long."""
        now = self._clock.now()
        newest = self._words[System.TICK]
        if now - newest < CLOCK_TICKS:
            self._is_reported = False
            return
        silent_s = (now - newest) * self._clock.period_ns * 1e-9
        clock = self._words[System.CLOCK_PID]
        state = state_of(clock)
        # A clock that could run is only late. Twice: after a pause of the whole machine it may be
        # about to wake.
        waits = silent_s > CLOCK_SILENT_S and state in WAITING
        has_stopped = state in STOPPED + GONE or (waits and self._waited_at == newest)
        self._waited_at = newest if waits else -1
        # A new tick, or the end of the run, disproves it.
        if (
            has_stopped
            and not self._is_reported
            and self._words[System.TICK] == newest
            and not self._clock.is_stopped
        ):
            self._is_reported = True
            self._alarms.ring(now, Alarm.CLOCK_STOPPED, clock, value=now - newest, since=newest)
