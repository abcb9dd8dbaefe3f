"""Faults as directed by the clock's board: each waits, becomes active and ends, at ticks.

The board itself acts the faults that no task can: signals to processes, forged messages, faults of
its own ticks.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

from rack.backplane.clock.driver import ClockDriver
from rack.backplane.clock.released_task import ReleasedTask
from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import NEVER, FaultEntry, FaultTable, Stage
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.faults.bounds import struck_mailboxes
from rack.boards.faults.describe import board_of
from rack.boards.faults.kind import kind_of
from rack.boards.faults.message_steps import Babble, forge

OPEN = (Stage.WAITING, Stage.ACTIVE)
PHASES = 1000
"""Resolution of a phase, per tick."""
LEAST_LATE = 0.6
"""Smallest delay of a tick, in ticks; boards call a tick late from 0.5 on."""


Strike = Callable[["FaultStage", FaultEntry, int], None]
"""What is done to a rack for an entry of the fault table, at a tick."""


def _nothing(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class ClockStep:
    """A step of the clock's board: as the fault begins, in each of its ticks, and as it ends.

    `is_void` says whether a fault has lost its object and ends early.
    """

    begin: Strike = _nothing
    during: Strike = _nothing
    end: Strike = _nothing
    is_void: Callable[[FaultStage, FaultEntry], bool] = lambda rack, entry: False


def _kill(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    task = rack.target(entry)
    if task is None:
        # The clock kills itself: its successor finds the entry struck.
        entry.acted(tick)
        os.kill(os.getpid(), signal.SIGKILL)
        return
    # The crate marks the task lost, then counts the loss. The system controller acts on the count:
    # wait for both.
    words = rack.segment.words
    before = words[System.LOSSES]
    if rack.send(entry, tick, task, signal.SIGKILL):
        rack.driver.await_state(task, lambda: task.is_lost and words[System.LOSSES] != before)


def _hang(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    task = rack.target(entry)
    if task is not None and rack.send(entry, tick, task, signal.SIGSTOP):
        task.is_stopped = True
        if task.spec.role == "host":
            # The Rack ends its process some time; lockstep waits for that here.
            rack.driver.await_state(task, lambda: task.is_lost)


def _continue(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    task = rack.target(entry)
    if task is not None and task.is_stopped and not task.is_lost:
        with suppress(ProcessLookupError):
            os.kill(task.block[Block.PID], signal.SIGCONT)
        task.is_stopped = False
        rack.driver.settle()


def _is_lost(rack: FaultStage, entry: FaultEntry) -> bool:
    task = rack.target(entry)
    return task is not None and task.is_lost


def _masquerade(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    entry.acted(tick)
    forge(rack.segment, rack.segment.layout.mailboxes[entry.mailbox].name, tick)


def _stop_clock(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    entry.acted(tick)
    os.kill(os.getpid(), signal.SIGSTOP)


def _skip(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    entry.acted(tick)
    rack.driver.skip = int(entry.parameters[0])
    rack.driver.count_skipped(tick, rack.driver.skip)


def _delay(rack: FaultStage, entry: FaultEntry, tick: int) -> None:
    entry.acted(tick)
    part = random.Random(entry.seed + tick).uniform(LEAST_LATE, entry.parameters[0])
    until = rack.clock.time_of(tick) + int(part * rack.clock.period_ns)
    # A tick is delayed by less than a tick period, so the grid itself stays.
    time.sleep(max(0, until - time.monotonic_ns()) * 1e-9)


KILL = ClockStep(_kill)
HANG = ClockStep(_hang, end=_continue, is_void=_is_lost)
MASQUERADE = ClockStep(_masquerade)
CLOCK_STOP = ClockStep(_stop_clock)
CLOCK_SKIP = ClockStep(_skip)
CLOCK_JITTER = ClockStep(during=_delay)
ELSEWHERE = ClockStep()
"""The step of a fault that acts in another process."""


def _step(entry: FaultEntry) -> ClockStep:
    step = kind_of(entry).step
    return step if isinstance(step, ClockStep) else ELSEWHERE


def _next_change(entry: FaultEntry, tick: int) -> int:
    """Return the first tick after `tick` at which a fault may begin, act or end."""
    if entry.stage == Stage.WAITING:
        return tick + 1 if entry.when_box >= 0 else max(tick + 1, entry.tick)
    if entry.stage == Stage.ACTIVE:
        may_end_early = kind_of(entry).once or _step(entry) is not ELSEWHERE
        return tick + 1 if may_end_early else entry.until
    return NEVER


class FaultStage:
    """Begins and ends faults at ticks, before any task of the tick is released; sees messages flow
    again after them.

    In lockstep a process is struck between two cycles, once it has finished its release, and the
    run continues once its end is known. So a run with faults is repeatable. In real time a fault
    with a phase strikes within its tick, after the releases.

    Attributes:
        injected: Number of faults that have come.
        next_tick: Until then there is nothing to do, unless more faults come.
    """

    def __init__(self, segment: Segment, driver: ClockDriver) -> None:
        self.segment = segment
        self.driver = driver
        self.clock = SystemClock(segment)
        self._words = segment.words
        self._table = FaultTable(segment)
        self._observer = cache(
            lambda box: open_observer(segment, segment.layout.mailboxes[box].name)
        )
        self.injected = 0
        self.next_tick = 0
        self._awaited: dict[int, int] = {}
        """By mailbox, as an index, the tick from which a message must be."""
        if self._words[System.STATE] == Run.RUNNING:
            # A restarted clock does not know what its predecessor has seen.
            for entry in self._table.staged((Stage.OVER,)):
                self._await_messages(entry)
        self._phased: list[FaultEntry] = []

    def target(self, entry: FaultEntry) -> ReleasedTask | None:
        """Return the task, or host board, that a fault strikes; None: the clock."""
        return next((task for task in self.driver.processes if task.index == entry.task), None)

    def send(
        self, entry: FaultEntry, tick: int, task: ReleasedTask, number: signal.Signals
    ) -> bool:
        """Send a signal to a task's process; return False if there is no such process."""
        pid = task.block[Block.PID]
        # A host board whose program is done, or given up, or which a replay does without, has no
        # process; the crate may not have seen yet that one has ended.
        if task.is_lost or task.block[Block.STATE] > TaskState.RUNNING or pid <= 0:
            return False
        entry.acted(tick)
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            return False
        return True

    def advance(self, tick: int) -> None:
        """Begin the faults due at `tick`, and end those that are over."""
        self.injected = self._words[System.INJECTED]
        faults = self._table.staged(OPEN)
        active = [entry for entry in faults if entry.stage == Stage.ACTIVE]
        waiting = [entry for entry in faults if entry.stage == Stage.WAITING]
        over = [entry for entry in active if self._is_over(entry, tick)]
        due = [entry for entry in waiting if self._is_due(entry, tick)]
        if over or due:
            # A running cycle finishes with the faults with which it began.
            self.driver.settle()
        for entry in over:
            entry.stage = Stage.OVER
            # Some end early: they strike once, or have lost their object.
            entry.until = min(entry.until, tick)
            self._words[System.FAULTS] += 1
            _step(entry).end(self, entry, tick)
            self.driver.alarms.ring(tick, Alarm.FAULT_ENDS, entry.index, entry.count)
            self._await_messages(entry)
        for entry in due:
            self._begin(entry, tick)
        active = [entry for entry in faults if entry.stage == Stage.ACTIVE]
        for entry in active:
            _step(entry).during(self, entry, tick)
        self.driver.is_flooded = any(kind_of(entry).step is Babble for entry in active)
        for box, since in list(self._awaited.items()):
            observer = self._observer(box)
            if observer.read(tick - 1).is_there and observer.newest >= since:
                del self._awaited[box]
                self.driver.alarms.ring(tick, Alarm.FLOWS, box, tick - since, since)
        # While rings are flooded, ticks must come one at a time: the recorder keeps up with each.
        must_look = self._awaited or self.driver.is_flooded
        changes = [tick + 1] if must_look else [_next_change(entry, tick) for entry in faults]
        self.next_tick = min(changes, default=NEVER)

    def within(self, tick: int) -> None:
        """Let the faults with a phase in `tick` strike at their times; call it after the
        releases.
        """
        if not self._phased:
            return
        clock = self.clock
        for entry in sorted(self._phased, key=lambda e: e.phase):
            at = clock.time_of(tick) + entry.phase * clock.period_ns // PHASES
            time.sleep(max(0, at - time.monotonic_ns()) * 1e-9)
            _step(entry).begin(self, entry, tick)
        self._phased.clear()

    def _is_over(self, entry: FaultEntry, tick: int) -> bool:
        kind = kind_of(entry)
        has_acted = kind.once and kind.is_of_task and entry.count > 0
        return entry.until <= tick or has_acted or _step(entry).is_void(self, entry)

    def _is_due(self, entry: FaultEntry, tick: int) -> bool:
        """Say whether a fault begins. Its condition is read in every tick, so that no message is
        missed.

        It is read as of the tick before: the clock works ahead of the grid, where messages of
        `tick` may be missing.
        """
        if entry.when_box < 0:
            return entry.tick <= tick
        observer = self._observer(entry.when_box)
        reading = observer.read(tick - 1)
        field = observer.spec.fields[entry.when_field].name
        return reading.is_there and int(getattr(reading.message, field)) == entry.when_value

    def _begin(self, entry: FaultEntry, tick: int) -> None:
        kind = kind_of(entry)
        entry.tick = tick
        lasts = entry.ticks
        if kind.once and not kind.is_of_task:
            # Such a fault of a task stays active until the task's next cycle.
            lasts = 1
        entry.until = tick + lasts if lasts else NEVER
        entry.stage = Stage.ACTIVE
        self._words[System.FAULTS] += 1
        self.driver.alarms.ring(tick, Alarm.FAULT_BEGINS, entry.index)
        if entry.phase and not self.clock.is_lockstep:
            self._phased.append(entry)
        else:
            _step(entry).begin(self, entry, tick)

    def _await_messages(self, entry: FaultEntry) -> None:
        layout = self.segment.layout
        if kind_of(entry).takes_mailbox:
            for box in struck_mailboxes(layout, entry.mailbox, board_of(entry, layout)):
                self._awaited[layout.mailboxes.index(box)] = entry.until
