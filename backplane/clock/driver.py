"""The system controller's side of the clock: advances the tick and releases the tasks that are due.

In real time the grid point of a tick is the time on CLOCK_MONOTONIC at which its cycles start. If
any task sleeps by its own timer (`wake = "timer"`), the clock begins each tick a little before its
grid point, so that the task finds its release when it wakes up. The clock therefore evaluates
conditions on messages for tick T as of tick T - 1, in both clock modes. Tasks that wait for a
signal, or poll, are released at the grid point, until which the clock sleeps a second time.

Alternative considered: tasks that release themselves. Before the first cycle of a tick, the clock
decides about faults, operator commands, skipped ticks and the return of restarted boards. With
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
from rack.backplane.clock.wake import CHECK_NS
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Run, System

LEAD_NS = 300_000
"""Time in ns by which the clock begins a tick ahead of the tick's grid point.

It suffices for the clock's wake-up and its work in a tick.
"""
LATE_DIVISOR = 2
"""A delay of more than one tick divided by this number shows that a core was taken away.

Both late wake-ups of the clock and idle time while tasks are due are compared with it.
"""
LEAD_DIVISOR = 3
"""The clock's lead over its grid point is at most one tick divided by this number."""

FindEndTick = Callable[[int], int | None]
"""Function called with every tick before it begins.

Returns the tick before which the run stops, or None while that is not known.
"""


class Controller(Protocol):
    """Work that the system controller does at every tick, apart from releasing tasks."""

    def begin_tick(self, tick: int) -> None:
        """Do the work that is due before the tasks of `tick` are released."""

    def finish_release(self, tick: int) -> None:
        """Do the work that is due after the tasks of `tick` have been released."""

    def find_next_work_tick(self, tick: int) -> int:
        """Return the first tick after `tick` at which `begin_tick` is known to have work."""


class ClockDriver(ABC):
    """Base class of both clock modes: advances ticks, releases tasks and ends the run.

    Attributes:
        controller: Other work of the system controller, set by the clock's board. None if there
            is no such work.
        skip: Number of ticks that the clock still has to skip because of a fault.
        tasks: Tasks in the order of their release.
        processes: Tasks and host boards. The clock does not release host boards.
        is_flooded: True while a fault makes a task flood its mailboxes, so that messages are
            overwritten earlier than usual.
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
        self._next = 0  # earliest possible end tick of the run, in lockstep the next tick
        self.alarms = alarms or AlarmWriter(segment, CLOCK)
        self.watchdog = Watchdog(self.alarms, self.words[System.PERIOD_NS])
        self._ended = ended
        self._segment = segment

    def begin_tick(self, tick: int) -> bool:
        """Publish `tick` as the current tick and do the work that is due before its releases.

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
        """Add `ticks` to the published number of skipped ticks. `first` is the first of them.

        `first` is stored before the number, which changes once for all these ticks. A late task
        therefore never reports only some of them, nor ticks that were skipped after its release.
        """
        self.words[System.SKIPPED_FROM] = first
        self.words[System.CLOCK_SKIPPED] += ticks

    def list_due_tasks(self, tick: int, last: int) -> list[ReleasedTask]:
        """Return the tasks to be released at `tick`, in the order of their release.

        These are the tasks with a release tick after `last` and not after `tick`, except tasks that
        are lost or still working on a plan.
        """
        due_tasks: list[ReleasedTask] = []
        for every, phase, tasks in self._groups:
            release = tick - (tick - phase) % every
            if release > last:
                due_tasks += [task for task in tasks if task.can_take_release(release)]
        return due_tasks

    def check_tasks(self, released: list[ReleasedTask], tick: int) -> None:
        """Pass each released task that missed a release to the watchdog. Call `finish_release`."""
        for task in released:
            if task.missed:
                self.watchdog.check(task, tick)
        if self.controller is not None:
            self.controller.finish_release(tick)

    @property
    def first_tick(self) -> int:
        """First tick that this process runs: 0, or after a restart of the clock the current tick.

        That tick is repeated. Tasks that were released at that tick before the restart are
        recognised by their deadlines and are not released again.
        """
        return self.words[System.TICK] if self.words[System.STATE] == Run.RUNNING else 0

    def wait_until_settled(self) -> None:
        """In lockstep, wait until every task has finished its last release, including plans.

        Call this before changing data that tasks read during a cycle. In real time it returns at
        once, so such a change may take effect in the middle of a cycle.
        """

    def await_state(self, task: ReleasedTask, condition: Callable[[], bool]) -> bool:
        """In lockstep, wait until a condition on a task's state is true. In real time, do not wait.

        Args:
            task: Task on whose state the condition depends.
            condition: Function that evaluates the condition, called after each report of the task.

        Returns:
            False if the launcher has ended or the host requests the end of the run.
        """
        return True

    @abstractmethod
    def run(self) -> None:
        """Run the clock until the run is over or the launcher has ended."""

    def is_over(self, tick: int) -> bool:
        """Return True if the run ends before `tick`. Publishes the end tick once it is known."""
        words = self.words
        stop = words[System.STOP_TICK]
        if words[System.STOP_REQUEST] and (not stop or stop > tick):
            stop = words[System.STOP_TICK] = max(tick, 1)
        if stop and tick >= stop:
            return True
        # Call `_ended` even if the end tick of this run is known. It also determines when the
        # robot's task ends, and a run that continues this one may end at that tick.
        end_tick = self._ended(tick)
        if not stop and end_tick is not None:
            stop = words[System.STOP_TICK] = max(end_tick, self._next, 1)
        return bool(stop) and tick >= stop

    def end_run(self) -> None:
        """Publish that the run has ended, and wake every task so that it notices."""
        self.words[System.STATE] = Run.STOPPED
        for task in self.tasks:
            task.wake()


class RealtimeDriver(ClockDriver):
    """Driver of the clock in real time.

    Tick T has its grid point at a fixed time of CLOCK_MONOTONIC. If the clock wakes up too late,
    it skips the ticks whose time has passed, and counts them.
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
        """Run the clock until the run is over or the launcher has ended."""
        beat = max(1, CHECK_NS // self._period_ns)
        for task in self.tasks:
            if task.sleeps:
                # Wake the task once. The grid is known now, so it can sleep until its grid points.
                task.wake()
        last = self.first_tick - 1
        # The grid point of tick 0 is a little after the clock's start, so wait for it too.
        tick = self._sleep_until_next(last)
        self.words[System.STATE] = Run.RUNNING
        while not self.is_over(tick):
            if self.begin_tick(tick):
                self._release_tasks(tick, last)
                if tick // beat != last // beat and not self._segment.launcher_is_alive:
                    break
                last = tick
            tick = self._sleep_until_next(tick)
        self._sleep_until(self._compute_grid_point(tick))
        self.end_run()

    def _release_tasks(self, tick: int, last: int) -> None:
        """Release every task that has a release after tick `last` and up to `tick`.

        Tasks that wake themselves with a timer are released at once, ahead of the grid point. The
        others are released at the grid point.
        """
        due = self.list_due_tasks(tick, last)
        point = self._compute_grid_point(tick)
        sleeping = [task for task in due if task.sleeps]
        for task in sleeping:
            task.release(tick)
        now = self.words[System.TICK_NS] = time.monotonic_ns()
        if now >= point or tick > last + 1:
            for task in sleeping:
                # The task woke up at its grid point, found no release because the clock was late,
                # and went back to sleep.
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
        """Sleep until a time, in ns of CLOCK_MONOTONIC."""
        # Repeat the wait, because rounding may end it slightly early.
        while (wait := time_ns - time.monotonic_ns()) > 0:
            time.sleep(wait * 1e-9)

    def _sleep_until_next(self, tick: int) -> int:
        """Sleep until the clock must begin the tick after `tick`.

        An alarm is raised if the clock wakes up late. It has the highest priority on its core, so
        a late wake-up shows that the core was taken away from the rack.

        Returns:
            The newest tick that is due: `tick` + 1, or a later tick if ticks were skipped.
        """
        due_ns = self._compute_grid_point(tick + 1)
        has_ticked = self._woke_ns
        self._sleep_until(due_ns - self._lead_ns)
        self._woke_ns = time.monotonic_ns()
        now = (self._woke_ns + self._lead_ns - self._epoch_ns) // self._period_ns
        if stop := self.words[System.STOP_TICK]:
            # Never skip the run's last tick, so that tasks that are late for it are noticed.
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
