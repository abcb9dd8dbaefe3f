"""Waiting for the next cycle: `waituntil(next-cycle)` of the paper's pseudo-code.

A board blocks on its semaphore ("signal"). A board with its own core may busy-wait for its release ("poll") instead, if
a context switch is too large a part of its cycle.
"""

from __future__ import annotations

import os
from time import monotonic_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.process import GONE, STOPPED, WAITING, is_alive, state_of
from rack.backplane.segment import Segment
from rack.backplane.semaphores import wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Head, System

_RELEASED = int(Block.RELEASED)
_TICK = int(System.TICK)
CLOCK_TICKS = 2
"""Ticks after a missing release before the clock is checked."""
CLOCK_SILENT_S = 0.5
"""Time without a tick before the clock counts as stopped while its process waits: it cannot be waiting for a tick."""
CHECK_S = 0.25
"""A longer wait checks whether the launcher is still alive."""
SPINS = 100_000
"""Polls of the release between two checks of the launcher: some milliseconds."""


class NextCycle:
    """The releases of one task, on the grid. A late task skips the releases that passed, and counts them.

    An executor's release has passed at the next one. A planner's has passed at the end of its plan's time slice: until
    then it is taken late, as of its own tick, since its result depends on ticks alone.
    """

    def __init__(
        self, segment: Segment, task: str, poll: bool = False, clock_alarms: AlarmWriter | None = None
    ) -> None:
        """Wait for the releases of `task`; with `clock_alarms`, check a silent clock and raise an alarm there."""
        self._spec = segment.layout.task(task)
        self._clock = SystemClock(segment)
        self._block = segment.block(task)
        self._semaphore = wake_semaphore(segment.rack, task)
        self._launcher = segment.words[Head.LAUNCHER_PID], segment.words[Head.LAUNCHER_START]
        self._words = segment.words
        self._poll = poll
        self._clock_alarms = None if self._clock.is_lockstep else clock_alarms
        self._clock_is_silent = False
        self._waited_at = -1
        # A restarted planner takes no release from before its start.
        self._slack = 0
        self._last = self._block[Block.RELEASED]
        self._not_before = 0
        self.skipped = 0

    def wait(self) -> int | None:
        """Wait for the next release and return its tick; None when the run is over and every release was taken.

        Sets `skipped` to the releases that passed since the last one.
        """
        while True:
            # Read first: a task that is late for the run's last release still takes it, so that the miss is seen.
            is_over = self._clock.is_stopped
            # The task's own release, not the clock's tick: in lockstep its turn may come later in a tick.
            newest = self._block[_RELEASED]
            if newest > self._last and newest >= self._not_before:
                return self._take(newest)
            if is_over or not (self._spin() if self._poll else self._block_on_semaphore()):
                return None

    def _take(self, newest: int) -> int:
        """Take the oldest release that has not passed."""
        every = self._spec.every
        expected = max(self._last + 1, self._not_before)
        expected += -expected % every
        release = max(expected, newest - self._slack)
        self._clock_is_silent = False
        self.skipped = (release - expected) // every
        self._last = release
        self._slack = every * (self._spec.within_cycles - 1)
        if self._poll:
            self._take_posts(1 + self.skipped)
        return release

    def _block_on_semaphore(self) -> bool:
        self._semaphore.bind(CHECK_S if self._clock_alarms is None else self._patience_s())
        if not self._semaphore.wait():
            return True
        if self._clock_alarms is not None and self._last >= 0:
            self._check_clock(self._clock_alarms)
        return is_alive(*self._launcher)

    def _patience_s(self) -> float:
        """Return how long to wait for the next release, s, before the clock is checked."""
        if self._last < 0:
            return CHECK_S
        every = self._spec.every
        late = self._clock.time_of(self._last + every - self._last % every + CLOCK_TICKS) - monotonic_ns()
        again = CLOCK_TICKS * self._clock.period_ns
        return min((late if late > 0 else again) * 1e-9, CHECK_S)

    def _check_clock(self, alarms: AlarmWriter) -> None:
        """Raise one alarm for a clock that makes no ticks: its process is stopped, dead, or silent for too long."""
        now, newest = self._clock.now(), self._words[_TICK]
        if now - newest < CLOCK_TICKS:
            self._clock_is_silent = False
            return
        silent_s = (now - newest) * self._clock.period_ns * 1e-9
        clock = self._words[System.CLOCK_PID]
        state = state_of(clock)
        # A clock that could run is only late. Twice: after a pause of the whole machine it may be about to wake.
        waits = silent_s > CLOCK_SILENT_S and state in WAITING
        has_stopped = state in STOPPED + GONE or (waits and self._waited_at == newest)
        self._waited_at = newest if waits else -1
        # A new tick, or the end of the run, disproves it.
        if has_stopped and not self._clock_is_silent and self._words[_TICK] == newest and not self._clock.is_stopped:
            self._clock_is_silent = True
            alarms.ring(now, Alarm.CLOCK_STOPPED, clock, value=now - newest, since=newest)

    def _spin(self) -> bool:
        block, last = self._block, self._last
        for _ in range(SPINS):
            if block[_RELEASED] > last:
                return True
        os.sched_yield()
        return is_alive(*self._launcher)

    def _take_posts(self, count: int) -> None:
        """Take the posts that a polling task does not wait for: else the semaphore would overflow within weeks."""
        # The newest post may follow its release a moment later: the next cycle takes it.
        while count and self._semaphore.acquire(0):
            count -= 1

    def hold_until(self, tick: int) -> None:
        """Take no release before `tick`: a planner keeps the time slice of its plan."""
        self._not_before = tick
