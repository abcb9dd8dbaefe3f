"""Waiting for the next cycle: `waituntil(next-cycle)` of the paper's pseudo-code.

The grid point of a tick is its time on CLOCK_MONOTONIC.

"timer": the task sleeps until its next grid point, at which it finds its release, because the clock
works a little ahead of the grid (`rack.backplane.clock.driver`). Its lateness is then the lateness
of one wake-up, not of two in a row (clock, then task). If there is no release, the clock is late,
stopped, or has skipped a tick. The task then sleeps until its next grid point, unless the late
clock posts its semaphore earlier. A wait of more than `MAX_SLEEP_NS` is a wait for the semaphore
with the grid point as its deadline, so that the end of a run interrupts it. Shorter waits are plain
sleeps, which take less processor time.

"signal": the task blocks on its semaphore until the clock posts it at the grid point.

"poll": a task with a dedicated core busy-waits for its release, for cycles in which a context
switch would take too large a share.

In lockstep there is no grid: a task that would sleep is woken by a signal.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from time import monotonic_ns, sleep

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, WAITING_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore, get_wake_semaphore
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Run, System

# Plain integers for the hot path.
_STOPPED = int(Run.STOPPED)
CHECK_S = 0.25
"""Time after which a waiting task checks whether the launcher is still alive."""
CHECK_NS = int(CHECK_S * 1e9)
MAX_SLEEP_NS = 25_000_000
"""Longest sleep that cannot be interrupted."""
POLLS_PER_CHECK = 100_000
"""Number of polls between two checks of the launcher. This many take some milliseconds."""


class NextCycle:
    """Waits for the releases of one task. A late task skips releases that have expired.

    An executor's release expires at the task's next release. In lockstep, however, all releases of
    a batch are taken, one after the other. A planner's release expires at the end of the plan's
    time slice. A planner that takes its release late still reads mailboxes as of the release tick,
    so that the plan depends on ticks alone.

    Attributes:
        skipped: Number of releases skipped just before the last one taken.
    """

    def __init__(
        self, segment: Segment, task: str, clock_alarms: AlarmWriter | None = None
    ) -> None:
        """Wait for the releases of a task.

        Args:
            segment: Memory of the rack.
            task: Name of the task.
            clock_alarms: Alarm ring of the task, to report a clock that has stopped. None if this
                task does not check the clock.
        """
        self._spec = spec = segment.layout.find_task(task)
        self._words = segment.words
        self._block = segment.get_block(task)
        self._semaphore = get_wake_semaphore(segment, task)
        self._segment = segment
        self._notify_clock: Callable[[], object] = get_done_semaphore(segment, task).release
        is_lockstep = bool(segment.words[System.LOCKSTEP])
        self._sleeps = spec.wake == "timer" and not is_lockstep
        self._is_posted = not self._sleeps and spec.wake != "poll"
        self._pause: Callable[[], bool] = self._block_on_semaphore
        if self._sleeps:
            self._pause = self._sleep_until_release
        elif spec.wake == "poll":
            self._pause = self._poll_release
        elif is_lockstep:
            self._pause = self._await_post
        self._takes_batches = is_lockstep and spec.role == "executor"
        self._newest = -1
        self._silent_clock = (
            None
            if is_lockstep or clock_alarms is None
            else StoppedClockDetector(segment, clock_alarms)
        )
        # A restarted task skips the releases before its start. This process may write RELEASED
        # here, because the clock does not write it before the task has rejoined.
        self._block[Block.RELEASED] = self._block[Block.DONE]
        self._due = spec.grid.find_tick(self._block[Block.DONE] + 1)
        self._slack = 0
        self.skipped = 0
        self.copy: Callable[[], None] | None = None
        """Function called between two cycles to fork a copy of the task for a snapshot."""
        self.serve_request: Callable[[], None] | None = None
        """Function called before each wait in a copy of a task, which may have to take over."""

    def wait(self) -> int | None:
        """Wait for the task's next release, take it, and set `skipped`.

        Returns:
            The tick of this release. None if the run is over and no release is left to take, or if
                the launcher has ended.
        """
        words = self._words
        block = self._block
        is_posted = self._is_posted
        while True:
            # Read the state before RELEASED, so that a task that is late for the run's last
            # release still takes it and the miss is noticed.
            is_over = words[System.STATE] == _STOPPED
            # Read the newest release of the task, not the clock's tick, because in lockstep the
            # clock may begin a tick some time before it releases the task.
            newest = block[Block.RELEASED]
            if self._sleeps and newest >= self._due:
                point = words[System.EPOCH_NS] + newest * words[System.PERIOD_NS]
                if monotonic_ns() < point:
                    # The clock gives releases ahead of their grid points. Do not take this one yet,
                    # but take the previous one if that has not expired.
                    newest -= self._spec.every
            if newest >= self._due:
                if is_posted and newest != self._newest:
                    # The task did not have to wait for this release or batch, so its post is still
                    # pending. Consume it, because the semaphore would overflow within weeks.
                    self._semaphore.try_acquire()
                self._newest = newest
                return self._take_release(newest)
            if block[Block.COPY] > 0 and self.copy is not None:
                self.copy()
            if self.serve_request is not None:
                self.serve_request()
            if is_over or not self._pause():
                return None
            is_posted = False

    def _take_release(self, newest: int) -> int:
        """Take the oldest release that has not expired, and return its tick.

        Args:
            newest: Newest release given to the task.
        """
        every = self._spec.every
        expected = self._due
        oldest = self._block[Block.FIRST] if self._takes_batches else newest - self._slack
        release = max(expected, oldest)
        self.skipped = (release - expected) // every
        self._due = release + every
        self._slack = every * (self._spec.within_cycles - 1)
        if self._silent_clock is not None:
            self._silent_clock.is_reported = False
        return release

    def _sleep_until_release(self) -> bool:
        """Sleep until the grid point of the next release.

        If that grid point has passed, sleep until the task's first grid point in the future, or
        until the late clock posts the semaphore.

        Returns:
            False if the launcher has ended.
        """
        words = self._words
        now = monotonic_ns()
        deadline = bound = now + CHECK_NS
        is_due = False
        # The grid is unknown until the clock starts. When it starts, it wakes every task once.
        if epoch := words[System.EPOCH_NS]:
            point = epoch + self._due * words[System.PERIOD_NS]
            step = self._spec.every * words[System.PERIOD_NS]
            if now < point < now + MAX_SLEEP_NS:
                sleep((point - now) * 1e-9)
                return True
            is_due = now < point <= bound
            if point <= now:
                point += ((now - point) // step + 1) * step
            deadline = min(bound, point)
        self._semaphore.set_deadline(deadline)
        if not self._semaphore.wait() or is_due or self._block[Block.RELEASED] >= self._due:
            return True
        return self._check_after_timeout()

    def _await_post(self) -> bool:
        """Wait for the semaphore in lockstep. Returns False if the launcher has ended."""
        # The deadline may have been set for an earlier wait. A timeout that comes too early only
        # costs one extra check.
        if not self._semaphore.wait():
            return True
        self._semaphore.set_deadline(monotonic_ns() + CHECK_NS)
        return self._check_after_timeout()

    def _block_on_semaphore(self) -> bool:
        """Wait for the semaphore in real time. Returns False if the launcher has ended."""
        bound = CHECK_NS
        if self._silent_clock is not None and self._has_begun:
            bound = min(bound, self._silent_clock.compute_patience_ns(self._due))
        self._semaphore.set_deadline(monotonic_ns() + bound)
        return not self._semaphore.wait() or self._check_after_timeout()

    def _poll_release(self) -> bool:
        """Busy-wait for the next release. Returns False if the launcher has ended."""
        block = self._block
        due = self._due
        for _ in range(POLLS_PER_CHECK):
            if block[Block.RELEASED] >= due:
                return True
        os.sched_yield()
        return self._segment.launcher_is_alive

    def _check_after_timeout(self) -> bool:
        """After a wait without a release, raise an alarm if the clock has stopped.

        Returns:
            False if the launcher has ended.
        """
        if self._silent_clock is not None and self._has_begun:
            self._silent_clock.check()
        return self._segment.launcher_is_alive

    @property
    def _has_begun(self) -> bool:
        """True if the task's first release is past. Before it, the clock may not have started."""
        return self._due > self._spec.phase

    def return_release(self, tick: int) -> None:
        """Return the release at `tick`, which `wait` has given: the next call counts it as skipped.

        That call gives it again if there is no newer one.
        """
        self._due = tick - self.skipped * self._spec.every

    def wait_for_tick(self, tick: int) -> None:
        """In lockstep, wait in the middle of a cycle until the clock has begun `tick`.

        The clock first gives the releases of that tick. The wait also ends with the run.
        """
        block = self._block
        block[Block.FINISH] = tick
        self._notify_clock()
        while block[Block.FINISH] and self._words[System.STATE] != _STOPPED:
            if block[Block.COPY] > 0 and self.copy is not None:
                self.copy()
            if not self._await_post():
                return

    def skip_until(self, tick: int) -> None:
        """Ignore releases before `tick`. A planner calls this to reserve its plan's time slice."""
        self._due = max(self._due, self._spec.grid.find_tick(tick))


CLOCK_PATIENCE_TICKS = 2
"""Number of ticks to wait for a missing release before the clock is checked."""
CLOCK_SILENT_S = 0.5
"""Time without a tick after which a clock with a blocked process is considered stopped.

This is longer than a clock ever waits for its next tick.
"""


class StoppedClockDetector:
    """Raises an alarm in one task's ring if the clock has stopped.

    The alarm is raised once each time the clock stops, and never if the clock is merely late.
    """

    def __init__(self, segment: Segment, alarms: AlarmWriter) -> None:
        self._words = segment.words
        self._clock = SystemClock(segment)
        self._alarms = alarms
        self.is_reported = False
        """True once the alarm is raised. A release resets it, as the clock has run since."""
        self._waited_at = -1

    def compute_patience_ns(self, expected: int) -> int:
        """Return the time, in ns, to wait for a release before the clock is checked.

        Args:
            expected: Tick of the release.
        """
        late = self._clock.compute_time_ns(expected + CLOCK_PATIENCE_TICKS) - monotonic_ns()
        return late if late > 0 else CLOCK_PATIENCE_TICKS * self._clock.period_ns

    def check(self) -> None:
        """Raise an alarm if ticks are overdue and the clock's process is stopped, dead or blocked.

        The alarm is raised once each time the clock stops.
        """
        now = self._clock.compute_tick()
        newest = self._words[System.TICK]
        if now - newest < CLOCK_PATIENCE_TICKS:
            self.is_reported = False
            return
        silent_s = (now - newest) * self._clock.period_ns * 1e-9
        clock = self._words[System.CLOCK_PID]
        state = read_state(clock)
        # If the process is runnable, the clock is merely late. If it is blocked, check twice,
        # because after a pause of the whole machine it may be about to wake up.
        waits = silent_s > CLOCK_SILENT_S and state in WAITING_STATES
        has_stopped = state in STOPPED_STATES + ENDED_STATES or (
            waits and self._waited_at == newest
        )
        self._waited_at = newest if waits else -1
        # If a new tick has begun meanwhile, or the run has ended, the clock is running.
        if (
            has_stopped
            and not self.is_reported
            and self._words[System.TICK] == newest
            and not self._clock.is_stopped
        ):
            self.is_reported = True
            self._alarms.raise_alarm(
                now, Alarm.CLOCK_STOPPED, clock, value=now - newest, since=newest
            )
