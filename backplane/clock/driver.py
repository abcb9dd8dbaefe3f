"""The system controller's side of the clock: makes the ticks and releases the tasks that are due.

In real time the clock works a little ahead of its grid, if any task sleeps by itself (`wake =
"timer"`): at tick T's grid point the tick is begun and its releases are there. Whatever the clock
reads as of T must then be final earlier: conditions on messages are evaluated as of T - 1, in both
modes alike. Tasks that wait for a signal, or poll, are released at the grid point, by a second
sleep of the clock within the tick.

Alternative considered: tasks that release themselves. Faults, operator commands, skipped ticks and
the return of a restarted board, all decided by the clock before a tick's first cycle, would then
depend on which process is faster.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import groupby
from typing import Protocol

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.released_task import ReleasedTask, Watchdog, by_priority
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, Run, System

LEAD_NS = 300_000
"""How far ahead of its grid point the clock begins a tick: room for its own wake-up and for the
work of a tick."""
LATE_PART = 2
"""A core was away if the clock wakes late, or nothing runs that is due, for more than one part in
so many of a tick."""
LEAD_PART = 3
"""The clock is ahead by at most one part in so many of a tick."""

Ended = Callable[[int], int | None]
"""Called before every tick; returns the tick at which the run stops, once that is known."""


class Controller(Protocol):
    """The system controller's work at every tick, apart from releasing tasks."""

    def begin(self, tick: int) -> None:
        """Do the work due before the tasks of `tick` are released."""

    def released(self, tick: int) -> None:
        """Do the work due after the release."""

    def rests_until(self, tick: int) -> int:
        """Return the first tick after `tick` that needs `begin`, as far as is known."""


class ClockDriver(ABC):
    """The part common to both modes: the tick, the releases, the end of the run.

    `controller` is set by the clock's board, if it has one. The next `skip` ticks are skipped.
    `processes`: the tasks, and the host boards, which the clock does not release. `is_flooded`: a
    fault makes a task write more than the rings are made for.
    """

    def __init__(self, segment: Segment, ended: Ended, alarms: AlarmWriter | None = None) -> None:
        self.words = segment.words
        self.tasks = [ReleasedTask(segment, task) for task in by_priority(segment.layout)]
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

    def begin(self, tick: int) -> bool:
        """Publish `tick` and do the work due before its releases; False when the tick is
        skipped.
        """
        self.words[System.TICK] = tick
        if self.controller is not None:
            self.controller.begin(tick)
        if not self.skip:
            return True
        self.skip -= 1
        return False

    def count_skipped(self, first: int, ticks: int) -> None:
        """Publish that the clock skips so many ticks from `first` on.

        All at once, and the count last: a late task must see neither half a skip nor one that began
        after its release.
        """
        self.words[System.SKIPPED_FROM] = first
        self.words[System.CLOCK_SKIPPED] += ticks

    def due(self, tick: int, last: int) -> list[ReleasedTask]:
        """Return the tasks with a release in (last, tick], in the order of their releases."""
        found: list[ReleasedTask] = []
        for every, phase, tasks in self._groups:
            release = tick - (tick - phase) % every
            if release > last:
                found += [task for task in tasks if task.is_free(release)]
        return found

    def check(self, released: list[ReleasedTask], tick: int) -> None:
        """Do the work due after the release of these tasks."""
        for task in released:
            if task.missed:
                self.watchdog.check(task, tick)
        if self.controller is not None:
            self.controller.released(tick)

    @property
    def first_tick(self) -> int:
        """First tick of this clock: 0, or after a restart the last tick again.

        No task is released twice for it: its deadline shows that it has been.
        """
        return self.words[System.TICK] if self.words[System.STATE] == Run.RUNNING else 0

    @property
    def first_end(self) -> int:
        """The first tick before which the run may end."""
        return 0

    def settle(self) -> None:
        """In lockstep, wait until each task has finished the work of its release, plans too; in
        real time a change may take effect within a cycle.

        Call it before changing anything that tasks read at any time rather than as of a tick.
        """

    def await_state(self, task: ReleasedTask, condition: Callable[[], bool]) -> bool:
        """In lockstep, wait until `condition` on the state of a task holds, which the task's
        reports make true; False when the launcher is gone. Real time does not wait.
        """
        return True

    @abstractmethod
    def run(self) -> None:
        """Make ticks until the run is over or the launcher is gone."""

    def is_over(self, tick: int) -> bool:
        """Say whether the run ends before `tick`."""
        words = self.words
        stop = words[System.STOP_TICK]
        if words[System.STOP_REQUEST] and (not stop or stop > tick):
            stop = words[System.STOP_TICK] = max(tick, 1)
        if stop and tick >= stop:
            return True
        # Asked even where the stop is known: a run that continues this one may end by it.
        found = self._ended(tick)
        if not stop and found is not None:
            stop = words[System.STOP_TICK] = max(found, self.first_end, 1)
        return bool(stop) and tick >= stop

    @property
    def launcher_is_alive(self) -> bool:
        """Whether the launcher still lives."""
        return self._segment.launcher_is_alive

    def end(self) -> None:
        """End the run, and wake every task so that it sees that."""
        self.words[System.STATE] = Run.STOPPED
        for task in self.tasks:
            task.wake()


class RealtimeDriver(ClockDriver):
    """The clock in real time, on an absolute grid of CLOCK_MONOTONIC. A late clock skips ticks and
    counts them.
    """

    def __init__(self, segment: Segment, ended: Ended, alarms: AlarmWriter | None = None) -> None:
        super().__init__(segment, ended, alarms)
        self._epoch_ns = self.words[System.EPOCH_NS]
        self._period_ns = self.words[System.PERIOD_NS]
        leads = any(task.sleeps for task in self.tasks)
        self._woke_ns = 0
        self._lead_ns = min(LEAD_NS, self._period_ns // LEAD_PART) if leads else 0

    def run(self) -> None:
        """Make ticks until the run is over or the launcher is gone."""
        words = self.words
        beat = max(1, int(CHECK_S * 1e9) // self._period_ns)
        for task in self.tasks:
            if task.sleeps:
                # The grid to sleep by exists now.
                task.wake()
        last = self.first_tick - 1
        # The grid begins a little after the clock's start, so that tick 0 has its grid point too.
        tick = self._sleep_until_next(last)
        words[System.STATE] = Run.RUNNING
        while not self.is_over(tick):
            if self.begin(tick):
                self._release(tick, last)
                if tick // beat != last // beat and not self.launcher_is_alive:
                    break
                last = tick
            tick = self._sleep_until_next(tick)
        self._sleep_until(self._time_of(tick))
        self.end()

    def _release(self, tick: int, last: int) -> None:
        """Give every task its release in (last, tick]: those that sleep in time, the others at the
        grid point.
        """
        due = self.due(tick, last)
        point = self._time_of(tick)
        sleeping = [task for task in due if task.sleeps]
        for task in sleeping:
            task.release(tick)
        now = self.words[System.TICK_NS] = time.monotonic_ns()
        if now >= point or tick > last + 1:
            for task in sleeping:
                # It has looked for its release already, and sleeps on.
                if now >= self._time_of(task.block[Block.RELEASED]):
                    task.wake()
        if len(sleeping) < len(due):
            self._sleep_until(point)
            for task in due:
                if not task.sleeps:
                    task.release(tick)
                    if task.is_posted:
                        task.wake()
        self.check(due, tick)

    def _time_of(self, tick: int) -> int:
        return self._epoch_ns + tick * self._period_ns

    def _sleep_until(self, time_ns: int) -> None:
        # Never early: the wait may end a rounding error before its end.
        while (wait := time_ns - time.monotonic_ns()) > 0:
            time.sleep(wait * 1e-9)

    def _sleep_until_next(self, tick: int) -> int:
        """Sleep until a tick begins; return the newest tick to begin by then, at least the one
        after `tick`.

        The clock preempts all else on its core: if it wakes late, that core was away. Reports tell
        stalls by it.
        """
        due_ns = self._time_of(tick + 1)
        has_ticked = self._woke_ns
        self._sleep_until(due_ns - self._lead_ns)
        self._woke_ns = time.monotonic_ns()
        now = (self._woke_ns + self._lead_ns - self._epoch_ns) // self._period_ns
        if stop := self.words[System.STOP_TICK]:
            # Even a late clock makes the run's last tick: tasks that are late for it are seen.
            now = min(now, stop - 1)
        next_tick = max(tick + 1, now)
        skipped = next_tick - tick - 1
        if skipped:
            self.count_skipped(tick + 1, skipped)
        # Before its first tick, at the start or after a restart, a late clock says nothing about
        # its core.
        if has_ticked and (late_ns := self._woke_ns - due_ns) > self._period_ns // LATE_PART:
            self.alarms.ring(next_tick, Alarm.CLOCK_LATE, value=late_ns, since=tick + 1)
        return next_tick
