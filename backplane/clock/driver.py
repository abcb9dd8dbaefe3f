"""The system controller's side of the clock: makes the ticks and releases the tasks that are due.

In real time the clock works a little ahead of its grid if any task sleeps by itself (`wake =
"timer"`): at tick T's grid point the tick has begun and its releases are in place. Whatever the
clock reads as of T must therefore be final earlier. Conditions on messages are evaluated as of T -
1, in both modes alike. Tasks that wait for a signal, or poll, are released at the grid point, by a
second sleep of the clock within the tick.

Alternative considered: tasks that release themselves. The clock decides faults, operator commands,
skipped ticks and the return of a restarted board before the first cycle of a tick. With
self-released tasks, all these would depend on which process is faster.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import groupby
from typing import Protocol

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.released_task import ReleasedTask, Watchdog, sort_by_priority
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Run, System

LEAD_NS = 300_000
"""Time by which the clock begins a tick ahead of its grid point.

It covers the clock's wake-up and its work in a tick.
"""
LATE_DIVISOR = 2
"""Divisor of the tick that gives the delay from which a core counts as taken away.

It applies to the clock's wake-up, and to time in which nothing runs although tasks are due.
"""
LEAD_DIVISOR = 3
"""Divisor of the tick that limits the time by which the clock is ahead."""

FindEndTick = Callable[[int], int | None]
"""Function called before every tick. Returns the tick at which the run stops, once known."""


class Controller(Protocol):
    """Work of the system controller at every tick, apart from releasing tasks."""

    def begin_tick(self, tick: int) -> None:
        """Do the work that is due before the tasks of `tick` are released."""

    def finish_release(self, tick: int) -> None:
        """Do the work that is due after the release."""

    def find_next_work_tick(self, tick: int) -> int:
        """Return the first tick after `tick` that needs `begin_tick`, as far as is known."""


class ClockDriver(ABC):
    """Part common to both clock modes: ticks, releases and the end of the run.

    Attributes:
        controller: Set by the clock's board, if it has one.
        skip: Number of next ticks to skip.
        tasks: Tasks in the order of their release.
        processes: Tasks and host boards. The clock does not release host boards.
        is_flooded: True if a fault makes a task write more than the rings are made for.
    """

    def __init__(
        self, segment: Segment, ended: FindEndTick, alarms: AlarmWriter | None = None
    ) -> None:
        self.words = segment.words
        self.tasks = [ReleasedTask(segment, task) for task in sort_by_priority(segment.layout)]
        self.processes = [
            *self.tasks,
            *(ReleasedTask(segment, host) for host in segment.layout.hosts),
        ]
        groups = groupby(
            self.tasks, key=lambda task: (task.spec.role, task.spec.every, task.spec.phase)
        )
        self._groups = [(every, phase, list(tasks)) for (_, every, phase), tasks in groups]
        self.controller: Controller | None = None
        self.skip = 0
        self.is_flooded = False
        self.alarms = alarms or AlarmWriter(segment, CLOCK)
        self.watchdog = Watchdog(self.alarms, self.words[System.PERIOD_NS])
        self._ended = ended
        self._segment = segment

    def begin_tick(self, tick: int) -> bool:
        """Publish `tick` and do the work that is due before its releases.

        Returns:
            False if the tick is skipped.
        """
        self.words[System.TICK] = tick
        if self.controller is not None:
            self.controller.begin_tick(tick)
        if not self.skip:
            return True
        self.skip -= 1
        return False

    def count_skipped(self, first: int, ticks: int) -> None:
        """Publish that the clock skips `ticks` ticks from `first` on.

        All are published at once, and the count is written last: a late task must see neither half
        a skip nor a skip that began after its release.
        """
        self.words[System.SKIPPED_FROM] = first
        self.words[System.CLOCK_SKIPPED] += ticks

    def list_due_tasks(self, tick: int, last: int) -> list[ReleasedTask]:
        """Return the tasks with a release in (last, tick], in the order of their releases."""
        due_tasks: list[ReleasedTask] = []
        for every, phase, tasks in self._groups:
            release = tick - (tick - phase) % every
            if release > last:
                due_tasks += [task for task in tasks if task.can_take_release(release)]
        return due_tasks

    def check_tasks(self, released: list[ReleasedTask], tick: int) -> None:
        """Do the work that is due after the release of these tasks."""
        for task in released:
            if task.missed:
                self.watchdog.check(task, tick)
        if self.controller is not None:
            self.controller.finish_release(tick)

    @property
    def first_tick(self) -> int:
        """First tick of this clock: 0, or the last tick again after a restart.

        No task is released twice for it, because its deadline shows that it has been released.
        """
        return self.words[System.TICK] if self.words[System.STATE] == Run.RUNNING else 0

    @property
    def first_end_tick(self) -> int:
        """First tick before which the run may end."""
        return 0

    def wait_until_settled(self) -> None:
        """In lockstep, wait until each task has finished the work of its release, including plans.

        Call it before a change of data that tasks read at any time rather than as of a tick. In
        real time it does not wait, so such a change may take effect within a cycle.
        """

    def await_state(self, task: ReleasedTask, condition: Callable[[], bool]) -> bool:
        """In lockstep, wait until a condition on the state of a task holds.

        In real time it does not wait.

        Args:
            task: Task whose reports make the condition true.
            condition: Function that is called after each report.

        Returns:
            False if the launcher has ended.
        """
        return True

    @abstractmethod
    def run(self) -> None:
        """Make ticks until the run is over or the launcher has ended."""

    def is_over(self, tick: int) -> bool:
        """Check whether the run ends before `tick`."""
        words = self.words
        stop = words[System.STOP_TICK]
        if words[System.STOP_REQUEST] and (not stop or stop > tick):
            stop = words[System.STOP_TICK] = max(tick, 1)
        if stop and tick >= stop:
            return True
        # Ask even if the stop is known, because a run that continues this one may end by the
        # answer.
        end_tick = self._ended(tick)
        if not stop and end_tick is not None:
            stop = words[System.STOP_TICK] = max(end_tick, self.first_end_tick, 1)
        return bool(stop) and tick >= stop

    @property
    def launcher_is_alive(self) -> bool:
        """True if the launcher is alive."""
        return self._segment.launcher_is_alive

    def end_run(self) -> None:
        """End the run, and wake every task so that it notices."""
        self.words[System.STATE] = Run.STOPPED
        for task in self.tasks:
            task.wake()


class RealtimeDriver(ClockDriver):
    """Clock in real time, on an absolute grid of CLOCK_MONOTONIC.

    A late clock skips ticks and counts them.
    """

    def __init__(
        self, segment: Segment, ended: FindEndTick, alarms: AlarmWriter | None = None
    ) -> None:
        super().__init__(segment, ended, alarms)
        self._epoch_ns = self.words[System.EPOCH_NS]
        self._period_ns = self.words[System.PERIOD_NS]
        leads = any(task.sleeps for task in self.tasks)
        self._woke_ns = 0
        self._lead_ns = min(LEAD_NS, self._period_ns // LEAD_DIVISOR) if leads else 0

    def run(self) -> None:
        """Make ticks until the run is over or the launcher has ended."""
        words = self.words
        beat = max(1, int(CHECK_S * 1e9) // self._period_ns)
        for task in self.tasks:
            if task.sleeps:
                # The task can sleep until its grid points from now on.
                task.wake()
        last = self.first_tick - 1
        # The grid begins a little after the clock's start, so that tick 0 has a grid point too.
        tick = self._sleep_until_next(last)
        words[System.STATE] = Run.RUNNING
        while not self.is_over(tick):
            if self.begin_tick(tick):
                self._release_tasks(tick, last)
                if tick // beat != last // beat and not self.launcher_is_alive:
                    break
                last = tick
            tick = self._sleep_until_next(tick)
        self._sleep_until(self._compute_grid_point(tick))
        self.end_run()

    def _release_tasks(self, tick: int, last: int) -> None:
        """Give every task its release in (last, tick].

        Tasks that sleep by themselves get it in advance, the others at the grid point.
        """
        due = self.list_due_tasks(tick, last)
        point = self._compute_grid_point(tick)
        sleeping = [task for task in due if task.sleeps]
        for task in sleeping:
            task.release(tick)
        now = self.words[System.TICK_NS] = time.monotonic_ns()
        if now >= point or tick > last + 1:
            for task in sleeping:
                # The task has already looked for its release, found none, and is sleeping again.
                if now >= self._compute_grid_point(task.block[Block.RELEASED]):
                    task.wake()
        if len(sleeping) < len(due):
            self._sleep_until(point)
            for task in due:
                if not task.sleeps:
                    task.release(tick)
                    if task.is_posted:
                        task.wake()
        self.check_tasks(due, tick)

    def _compute_grid_point(self, tick: int) -> int:
        """Return the grid point of a tick, in ns of CLOCK_MONOTONIC."""
        return self._epoch_ns + tick * self._period_ns

    def _sleep_until(self, time_ns: int) -> None:
        # Repeat the wait, because rounding may end it slightly early.
        """Sleep until a time, in ns of CLOCK_MONOTONIC."""
        while (wait := time_ns - time.monotonic_ns()) > 0:
            time.sleep(wait * 1e-9)

    def _sleep_until_next(self, tick: int) -> int:
        """Sleep until a tick begins.

        The clock preempts all else on its core, so if it wakes late, the core was taken away.
        Reports recognise stalls by this.

        Returns:
            The newest tick that is due to begin, at least `tick` + 1.
        """
        due_ns = self._compute_grid_point(tick + 1)
        has_ticked = self._woke_ns
        self._sleep_until(due_ns - self._lead_ns)
        self._woke_ns = time.monotonic_ns()
        now = (self._woke_ns + self._lead_ns - self._epoch_ns) // self._period_ns
        if stop := self.words[System.STOP_TICK]:
            # Even a late clock makes the run's last tick, so that tasks late for it are noticed.
            now = min(now, stop - 1)
        next_tick = max(tick + 1, now)
        skipped = next_tick - tick - 1
        if skipped:
            self.count_skipped(tick + 1, skipped)
        # Before its first tick, at the start or after a restart, a late clock does not prove that
        # its core was taken away.
        if has_ticked and (late_ns := self._woke_ns - due_ns) > self._period_ns // LATE_DIVISOR:
            self.alarms.raise_alarm(next_tick, Alarm.CLOCK_LATE, value=late_ns, since=tick + 1)
        return next_tick
