"""The clock in lockstep: a tick begins when every task due before it has finished. Exact, repeatable, and fast."""

from __future__ import annotations

import time
from collections.abc import Callable

from rack.backplane.clock.driver import ClockDriver, Ended
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.process import GONE, STOPPED, state_of
from rack.backplane.segment import Segment
from rack.backplane.semaphores import clock_semaphore
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.words import Run, System

IDLE_S = 5.0
"""Bound of the wait for a recorder that is stopped, or dead and not restarted."""
SLOW_S = 30.0
"""Bound of the wait for a recorder that runs but reads no rows: a new one may still be importing its libraries."""


class LockstepDriver(ClockDriver):
    """The driver of the clock in lockstep.

    `one_at_a_time` releases the tasks of a tick one after the other, planners too, and waits for each. Protocols whose
    messages are visible at once need this to be repeatable.
    """

    def __init__(
        self, segment: Segment, ended: Ended, one_at_a_time: bool, history_ticks: int, alarms: AlarmWriter | None = None
    ) -> None:
        super().__init__(segment, ended, alarms)
        self._done = clock_semaphore(segment.rack)
        self._one_at_a_time = one_at_a_time
        self._history_ticks = history_ticks

    def run(self) -> None:
        """Make ticks until the run is over or the launcher is gone."""
        tick = self.first_tick
        last = tick - 1
        self.words[System.STATE] = Run.RUNNING
        while not self.is_over(tick) and self._wait_for_follower(tick):
            if self.begin(tick):
                if not self._step(tick, last):
                    break
                last = tick
            tick += 1
        self.end()

    def _step(self, tick: int, last: int) -> bool:
        """Do one tick; False when the launcher is gone."""
        due = self.due(tick, last)
        for task in due:
            task.release(tick)
            task.wake()
            if self._one_at_a_time and not self._wait(task.is_settled):
                return False
        self.check(due, tick)
        return self._wait(lambda: all(task.is_finished(tick + 1) for task in self.tasks))

    def settle(self) -> None:
        """Wait until every task has finished the work of its release, plans too."""
        self._wait(lambda: all(task.is_settled() for task in self.tasks))

    def await_state(self, condition: Callable[[], bool]) -> None:
        """Wait until `condition` holds."""
        self._wait(condition)

    def _wait(self, condition: Callable[[], bool]) -> bool:
        while not condition():
            if self._done.acquire(CHECK_S):
                continue
            if not self.launcher_is_alive or self.words[System.STOP_REQUEST]:
                return False
            # A signal may have stopped a task: time must not wait for it.
            for task in self.tasks:
                task.check_stopped()
        return True

    def _wait_for_follower(self, tick: int) -> bool:
        """Wait for a recorder before its rings overflow: in lockstep time stands still meanwhile."""
        words = self.words
        seen, since = words[System.FOLLOWER_TICK], time.monotonic()
        while (pid := words[System.FOLLOWER_PID]) and tick - words[System.FOLLOWER_TICK] > self._history_ticks:
            if words[System.FOLLOWER_TICK] != seen:
                seen, since = words[System.FOLLOWER_TICK], time.monotonic()
            bound_s = IDLE_S if state_of(pid) in (*STOPPED, *GONE) else SLOW_S
            if time.monotonic() - since > bound_s:
                words[System.FOLLOWER_PID] = 0
            if words[System.STOP_REQUEST] or not self.launcher_is_alive:
                return False
            # Polled, since the recorder posts no semaphore: it must not be able to disturb the clock in real time.
            time.sleep(0.001)
        return True
