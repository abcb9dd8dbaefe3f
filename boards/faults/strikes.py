"""What the clock's board does to a rack when a fault is due: signals to processes, forged messages, its own ticks."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from contextlib import suppress

from rack.backplane.clock.driver import ClockDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import Entry, FaultEntry
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.faults.kinds import KINDS
from rack.boards.faults.masquerade import masquerade

LEAST_LATE = 0.6
"""Least lateness of a tick that is moved, in ticks: a board calls a tick late from half a tick on."""
Strike = Callable[[FaultEntry, int], None]


class Strikes:
    """Makes the faults that the clock's board does act.

    In lockstep a process is struck between two cycles, when it has finished what it was released for, and the run goes
    on when its end is known: so a run repeats with its faults.
    """

    def __init__(self, segment: Segment, driver: ClockDriver) -> None:
        self._segment, self._driver = segment, driver
        self._clock = SystemClock(segment)
        self._begin: dict[str, Strike] = {
            "kill": self._kill,
            "hang": self._hang,
            "masquerade": self._masquerade,
            "clock-stop": self._stop_clock,
            "clock-skip": self._skip,
        }
        self._end: dict[str, Strike] = {"hang": self._go_on}

    def settle(self) -> None:
        """Have every cycle that is under way end as it began, with the faults that there were."""
        self._driver.settle()

    def begin(self, entry: FaultEntry, tick: int) -> None:
        """Strike at the beginning of a fault, if it is this board that does."""
        strike = self._begin.get(KINDS[entry[Entry.KIND]].name)
        if strike is not None:
            strike(entry, tick)

    def during(self, entry: FaultEntry, tick: int) -> None:
        """Do what a fault that lasts does in every tick."""
        if KINDS[entry[Entry.KIND]].name == "clock-jitter":
            self._delay(entry, tick)

    def end(self, entry: FaultEntry, tick: int) -> None:
        """Undo what must not outlast a fault."""
        strike = self._end.get(KINDS[entry[Entry.KIND]].name)
        if strike is not None:
            strike(entry, tick)

    def is_void(self, entry: FaultEntry) -> bool:
        """Say whether there is nothing left of a fault: what it stops has stopped, or is found lost."""
        kind = KINDS[entry[Entry.KIND]]
        if kind.where == "lock":
            return entry[Entry.COUNT] > 0
        if kind.name != "hang":
            return False
        task = self._target(entry)
        return task is not None and task.lost_tick >= 0

    def _target(self, entry: FaultEntry) -> ReleasedTask | None:
        index = entry[Entry.TASK]
        return next((task for task in self._driver.tasks if task.index == index), None)

    def _kill(self, entry: FaultEntry, tick: int) -> None:
        task = self._target(entry)
        if task is None:
            # The clock's own end: whoever restarts it finds the entry struck.
            self._acts(entry, tick)
            os.kill(os.getpid(), signal.SIGKILL)
            return
        if self._send(entry, tick, task, signal.SIGKILL):
            self._driver.await_state(lambda: task.lost_tick >= 0)

    def _hang(self, entry: FaultEntry, tick: int) -> None:
        task = self._target(entry)
        if task is not None and self._send(entry, tick, task, signal.SIGSTOP):
            task.is_stopped = True

    def _go_on(self, entry: FaultEntry, tick: int) -> None:
        task = self._target(entry)
        if task is not None and task.is_stopped and task.lost_tick < 0:
            with suppress(ProcessLookupError):
                os.kill(task.block[Block.PID], signal.SIGCONT)
            task.is_stopped = False
            self.settle()

    def _send(self, entry: FaultEntry, tick: int, task: ReleasedTask, number: signal.Signals) -> bool:
        """Send a signal to a task's process; False when it is not there to be struck."""
        if task.lost_tick >= 0:
            return False
        self._acts(entry, tick)
        try:
            os.kill(task.block[Block.PID], number)
        except ProcessLookupError:
            return False
        return True

    def _masquerade(self, entry: FaultEntry, tick: int) -> None:
        mailbox = self._segment.layout.mailboxes[entry[Entry.MAILBOX]].name
        self._acts(entry, tick)
        masquerade(self._segment, mailbox, tick)

    def _stop_clock(self, entry: FaultEntry, tick: int) -> None:
        self._acts(entry, tick)
        os.kill(os.getpid(), signal.SIGSTOP)

    def _skip(self, entry: FaultEntry, tick: int) -> None:
        self._acts(entry, tick)
        self._driver.skip = int(entry.parameters[0])

    def _delay(self, entry: FaultEntry, tick: int) -> None:
        self._acts(entry, tick)
        part = random.Random(entry[Entry.SEED] + tick).uniform(LEAST_LATE, entry.parameters[0])
        until = self._clock.time_of(tick) + int(part * self._clock.period_ns)
        # Ticks are moved by less than a tick: the grid itself stays.
        time.sleep(max(0, until - time.monotonic_ns()) * 1e-9)

    def _acts(self, entry: FaultEntry, tick: int) -> None:
        entry.acted(tick, time.monotonic_ns())
