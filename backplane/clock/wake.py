"""Waiting for the next cycle: `waituntil(next-cycle)` of the paper's pseudo-code.

"timer": the task sleeps to its own grid point and finds its release there, since the clock works a
little ahead of the grid (`rack.backplane.clock.driver`). Its lateness is then that of one wake-up,
not of two in a row (clock, then task). If the release is missing, the clock is late, stopped, or
has skipped a tick: the task sleeps on to its next grid point, and the late clock wakes it with a
post. A sleep of more than `NEAR_NS` is a wait for the task's semaphore with the grid point as its
bound, so that the end of a run ends it; a shorter one takes less processor time.

"signal": the task blocks on its semaphore until the clock posts it at the grid point.

"poll": a task with its own core busy-waits for its release, if a context switch is too large a part
of its cycle.

In lockstep there is no grid: a task that would sleep is woken by a signal.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from time import monotonic_ns, sleep

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.process import GONE, STOPPED, WAITING, state_of
from rack.backplane.segment import Segment
from rack.backplane.semaphores import wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Run, System

# Plain integers for the hot path.
_STOPPED = int(Run.STOPPED)
CHECK_S = 0.25
"""A longer wait checks whether the launcher is still alive."""
NEAR_NS = 25_000_000
"""Longest sleep that nothing can end."""
SPINS = 100_000
"""Polls of the release between two checks of the launcher: some milliseconds."""


class NextCycle:
    """The releases of one task, on the grid. A late task skips the releases that passed, and counts
    them.

    An executor's release has passed at the next one; those that the clock gives at once in lockstep
    are taken one after the other. A planner's has passed at the end of its plan's time slice: until
    then it is taken late, as of its own tick, since its result depends on ticks alone.
    """

    def __init__(
        self, segment: Segment, task: str, clock_alarms: AlarmWriter | None = None
    ) -> None:
        """Wait for the releases of `task`; with `clock_alarms`, check a silent clock and raise an
        alarm there.
        """
        self._spec = spec = segment.layout.task(task)
        self._words = segment.words
        self._block = segment.block(task)
        self._semaphore = wake_semaphore(segment, task)
        self._segment = segment
        is_lockstep = bool(segment.words[System.LOCKSTEP])
        self._sleeps = spec.wake == "timer" and not is_lockstep
        self._is_posted = not self._sleeps and spec.wake != "poll"
        self._pause: Callable[[], bool] = self._block_on_semaphore
        if self._sleeps:
            self._pause = self._sleep
        elif spec.wake == "poll":
            self._pause = self._spin
        elif is_lockstep:
            self._pause = self._await_post
        self._takes_batches = is_lockstep and spec.role == "executor"
        self._newest = -1
        self._silent_clock = (
            None if is_lockstep or clock_alarms is None else SilentClock(segment, clock_alarms)
        )
        # A restarted task takes no release from before its start: those are skipped. The clock does
        # not write this word until the task has rejoined.
        self._block[Block.RELEASED] = self._block[Block.DONE]
        self._due = self._block[Block.DONE] + 1
        self.hold_until(self._due)
        self._slack = 0
        self.skipped = 0
        self.copy: Callable[[], None] | None = None
        """Called when the clock wants a copy of the task, between two cycles."""

    def wait(self) -> int | None:
        """Wait for the next release and return its tick; None when the run is over and every
        release was taken.

        Sets `skipped` to the releases that passed since the last one.
        """
        words = self._words
        block = self._block
        is_posted = self._is_posted
        while True:
            # Read first: a task that is late for the run's last release still takes it, so that the
            # miss is seen.
            is_over = words[System.STATE] == _STOPPED
            # The task's own release, not the clock's tick: in lockstep its turn may come later in a
            # tick.
            newest = block[Block.RELEASED]
            if self._sleeps and newest >= self._due and self._is_ahead(newest):
                # A task woken late may find the next release there already: the one before it is
                # still to be taken.
                newest -= self._spec.every
            if newest >= self._due:
                if is_posted and newest != self._newest:
                    # Its post, which nobody waited for: else the semaphore would overflow within
                    # weeks. A batch has one.
                    self._semaphore.take()
                self._newest = newest
                return self._take(newest)
            if block[Block.COPY] > 0 and self.copy is not None:
                self.copy()
            if is_over or not self._pause():
                return None
            is_posted = False

    def _take(self, newest: int) -> int:
        """Take the oldest release that has not passed."""
        every = self._spec.every
        expected = self._due
        oldest = self._block[Block.FIRST] if self._takes_batches else newest - self._slack
        release = max(expected, oldest)
        self.skipped = (release - expected) // every
        self._due = release + every
        self._slack = every * (self._spec.within_cycles - 1)
        if self._silent_clock is not None:
            self._silent_clock.has_ticked()
        return release

    def _is_ahead(self, release: int) -> bool:
        """Say whether the grid point of a release is yet to come."""
        return (
            monotonic_ns() < self._words[System.EPOCH_NS] + release * self._words[System.PERIOD_NS]
        )

    def _sleep(self) -> bool:
        """Sleep to the next release's grid point or, if that has passed, to the task's next one or
        a late release.
        """
        words = self._words
        now = monotonic_ns()
        deadline = bound = now + int(CHECK_S * 1e9)
        is_due = False
        # Before its start the clock has no grid. It then wakes every task once.
        if epoch := words[System.EPOCH_NS]:
            point = epoch + self._due * words[System.PERIOD_NS]
            step = self._spec.every * words[System.PERIOD_NS]
            if now < point < now + NEAR_NS:
                sleep((point - now) * 1e-9)
                return True
            is_due = now < point <= bound
            if point <= now:
                point += ((now - point) // step + 1) * step
            deadline = min(bound, point)
        self._semaphore.bind(deadline)
        if not self._semaphore.wait() or is_due or self._block[Block.RELEASED] >= self._due:
            return True
        return self._look_around()

    def _await_post(self) -> bool:
        # The bound may be that of an earlier wait: a timeout that comes early costs one look
        # around, no more.
        if not self._semaphore.wait():
            return True
        self._semaphore.bind(monotonic_ns() + int(CHECK_S * 1e9))
        return self._look_around()

    def _block_on_semaphore(self) -> bool:
        bound = int(CHECK_S * 1e9)
        if self._silent_clock is not None and self._has_begun:
            bound = min(bound, self._silent_clock.patience_ns(self._due))
        self._semaphore.bind(monotonic_ns() + bound)
        return not self._semaphore.wait() or self._look_around()

    def _spin(self) -> bool:
        block = self._block
        due = self._due
        for _ in range(SPINS):
            if block[Block.RELEASED] >= due:
                return True
        os.sched_yield()
        return self._segment.launcher_is_alive

    def _look_around(self) -> bool:
        """Check the clock, after a wait without a release; return False if the launcher is gone."""
        if self._silent_clock is not None and self._has_begun:
            self._silent_clock.check()
        return self._segment.launcher_is_alive

    @property
    def _has_begun(self) -> bool:
        """Whether a release is past: before the first one the clock may not have started."""
        return self._due > self._spec.phase

    def hold_until(self, tick: int) -> None:
        """Take no release before `tick`: a planner keeps the time slice of its plan."""
        self._due = max(self._due, self._spec.grid.since(tick))


CLOCK_TICKS = 2
"""Ticks after a missing release before the clock is checked."""
CLOCK_SILENT_S = 0.5
"""Time without a tick before the clock counts as stopped while its process waits: it cannot be
waiting for a tick."""


class SilentClock:
    """One task's check of a clock that makes no ticks. A late clock is not at fault."""

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
        `expected`.
        """
        late = self._clock.time_of(expected + CLOCK_TICKS) - monotonic_ns()
        return late if late > 0 else CLOCK_TICKS * self._clock.period_ns

    def check(self) -> None:
        """Raise one alarm for a clock that makes no ticks: its process is stopped, dead, or silent
        for too long.
        """
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
