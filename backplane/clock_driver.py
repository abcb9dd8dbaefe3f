"""The system controller's side of the clock: gives out ticks and releases the tasks that are due.

In real time ticks lie on an absolute grid of CLOCK_MONOTONIC. In lockstep a tick begins when every task
due by then has finished: exact, repeatable, as fast as the machine allows.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable

import posix_ipc

from backplane.layout import Layout, TaskSpec
from backplane.process import is_alive
from backplane.segment import Segment
from backplane.semaphores import clock_semaphore, wake_semaphore
from backplane.wake import CHECK_S
from backplane.words import Block, Head, Run, System

Ended = Callable[[int], int | None]
"""Called at every tick; returns the tick at which the run stops, once that is known."""


class ClockDriver(ABC):
    """What both modes share: the tick, the releases, the end of the run."""

    def __init__(self, segment: Segment, ended: Ended) -> None:
        self.words = segment.words
        self.tasks = [_Released(segment, task) for task in by_priority(segment.layout)]
        self._ended = ended
        self._launcher = self.words[Head.LAUNCHER_PID], self.words[Head.LAUNCHER_START]

    def release(self, tick: int, last: int) -> None:
        """Publish `tick`, then wake every task with a release in (last, tick]."""
        self.words[System.TICK] = tick
        for task in self.tasks:
            if task.is_due(tick, last):
                task.release(tick)

    @abstractmethod
    def run(self) -> None:
        """Give out ticks until the run is over or the launcher is gone."""

    def is_over(self, tick: int) -> bool:
        """Say whether the run ends before `tick`."""
        words = self.words
        if words[System.STOP_REQUEST] and not words[System.STOP_TICK]:
            words[System.STOP_TICK] = tick
        stop = words[System.STOP_TICK]
        if not stop and (found := self._ended(tick)) is not None:
            stop = words[System.STOP_TICK] = max(found, 1)
        return bool(stop) and tick >= stop

    @property
    def launcher_is_alive(self) -> bool:
        """Whether anybody is left to run for."""
        return is_alive(*self._launcher)

    def end(self) -> None:
        """End the run: wake everybody to see it."""
        self.words[System.STATE] = Run.STOPPED
        for task in self.tasks:
            task.wake()


class RealtimeDriver(ClockDriver):
    """Ticks on the grid of CLOCK_MONOTONIC. A late clock leaves ticks out and counts them."""

    def run(self) -> None:
        """Give out ticks until the run is over or the launcher is gone."""
        words = self.words
        period, epoch = words[System.PERIOD_NS], words[System.EPOCH_NS]
        beat = max(1, int(CHECK_S * 1e9) // period)
        # The grid begins a little after the clock: tick 0 has its grid point too.
        tick, last = self._sleep_until_next(-1, epoch, period), -1
        words[System.STATE] = Run.RUNNING
        while not self.is_over(tick):
            self.release(tick, last)
            if tick // beat != last // beat and not self.launcher_is_alive:
                break
            last = tick
            tick = self._sleep_until_next(tick, epoch, period)
        self.end()

    def _sleep_until_next(self, tick: int, epoch: int, period: int) -> int:
        """Sleep to the next grid point; return the newest tick that has come by then."""
        wait = epoch + (tick + 1) * period - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        now = (time.monotonic_ns() - epoch) // period
        # Never early: the wait may end a rounding error before its grid point.
        next_tick = max(tick + 1, now)
        self.words[System.CLOCK_SKIPPED] += next_tick - tick - 1
        return next_tick


class LockstepDriver(ClockDriver):
    """A tick begins when every task due by then has finished.

    `one_at_a_time` releases the tasks of a tick one after the other, each until it is done, planners
    too: exact with protocols that show a message at once.
    """

    def __init__(self, segment: Segment, ended: Ended, one_at_a_time: bool, history_ticks: int) -> None:
        super().__init__(segment, ended)
        self._done = clock_semaphore(segment.rack)
        self._one_at_a_time = one_at_a_time
        self._history_ticks = history_ticks

    def run(self) -> None:
        """Give out ticks until the run is over or the launcher is gone."""
        self.words[System.STATE] = Run.RUNNING
        tick = 0
        while not self.is_over(tick) and self._wait_for_follower(tick):
            if not self._step(tick):
                break
            tick += 1
        self.end()

    def _step(self, tick: int) -> bool:
        """Do one tick; False when the launcher is gone."""
        if not self._one_at_a_time:
            self.release(tick, tick - 1)
            return self._wait(lambda: all(task.is_finished(tick + 1) for task in self.tasks))
        self.words[System.TICK] = tick
        for task in self.tasks:
            if task.is_due(tick, tick - 1):
                task.release(tick)
                if not self._wait(task.is_idle):
                    return False
        return True

    def _wait(self, condition: Callable[[], bool]) -> bool:
        while not condition():
            try:
                self._done.acquire(CHECK_S)
            except posix_ipc.BusyError:
                if not self.launcher_is_alive or self.words[System.STOP_REQUEST]:
                    return False
        return True

    def _wait_for_follower(self, tick: int) -> bool:
        """Wait for a recorder before its rings run over: in lockstep time stands still meanwhile."""
        words = self.words
        while (pid := words[System.FOLLOWER_PID]) and tick - words[System.FOLLOWER_TICK] > self._history_ticks:
            if not is_alive(pid):
                words[System.FOLLOWER_PID] = 0
            if words[System.STOP_REQUEST] or not self.launcher_is_alive:
                return False
            # The recorder posts nothing: it must never be able to disturb the clock in real time.
            time.sleep(0.001)
        return True


class _Released:
    """One task as the clock sees it."""

    def __init__(self, segment: Segment, spec: TaskSpec) -> None:
        self.spec = spec
        self._block = segment.block(spec.name)
        self._semaphore = wake_semaphore(segment.rack, spec.name)

    def is_due(self, tick: int, last: int) -> bool:
        """Say whether a release of the task lies in (last, tick]; none does while it works on a plan."""
        release = tick - tick % self.spec.every
        return release > last and self._block[Block.DEADLINE] <= release

    def release(self, tick: int) -> None:
        """Wake the task for its newest release."""
        release = tick - tick % self.spec.every
        self._block[Block.DEADLINE] = release + self.spec.every
        self._block[Block.RELEASED] = release
        self._semaphore.release()

    def is_idle(self) -> bool:
        """Say whether the newest release is finished."""
        return self._block[Block.DONE] == self._block[Block.RELEASED]

    def is_finished(self, tick: int) -> bool:
        """Say whether nothing of the task must be waited for before `tick` begins."""
        return self._block[Block.DEADLINE] > tick or self.is_idle()

    def wake(self) -> None:
        """Wake the task without a release."""
        self._semaphore.release()


def by_priority(layout: Layout) -> list[TaskSpec]:
    """Return the tasks in the order in which the clock wakes them: executors by rate, then planners."""
    return sorted(layout.tasks, key=lambda t: (t.role == "planner", t.every, t.slot))
