"""Life cycle of faults, directed by the clock's board: waiting, active, over.

The board itself carries out the faults that no task can: signals to processes, forged messages, and
faults of the clock's ticks.
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
from rack.boards.faults.bounds import list_affected_mailboxes
from rack.boards.faults.describe import find_board
from rack.boards.faults.kind import find_kind
from rack.boards.faults.message_steps import Babble, forge_message

PHASES = 1000
"""Number of phases in a tick: a phase of 500 is the middle of the tick."""
REPORTED_TICKS = 0.5
"""Delay in ticks from which boards report a late tick."""


Strike = Callable[["FaultStage", FaultEntry, int], None]
"""Function that carries out one step of a fault at a tick."""


def _do_nothing(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Do nothing. This is the default for each step of a fault."""


@dataclass(frozen=True)
class ClockStep:
    """Steps of a fault that the clock's board carries out.

    Attributes:
        begin: Called when the fault begins.
        during: Called in each tick while it is active.
        end: Called when it ends.
        is_void: Returns True if the affected process is gone, so that the fault ends early.
    """

    begin: Strike = _do_nothing
    during: Strike = _do_nothing
    end: Strike = _do_nothing
    is_void: Callable[[FaultStage, FaultEntry], bool] = lambda rack, entry: False


def _kill_process(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Kill a task's process and, in lockstep, wait until the crate has recorded the loss.

    If the fault affects the clock, kill this process.
    """
    task = stage.find_target(entry)
    if task is None:
        # The clock kills itself. Mark the entry first, so that the restarted clock does not do it
        # again.
        entry.record_action(tick)
        os.kill(os.getpid(), signal.SIGKILL)
        return
    # The crate first marks the task as lost, then counts the loss, on which the system controller
    # acts. Wait for both.
    words = stage.segment.words
    losses = words[System.LOSSES]
    if stage.send_signal(entry, tick, task, signal.SIGKILL):
        stage.driver.await_state(task, lambda: task.is_lost and words[System.LOSSES] != losses)


def _stop_process(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Stop a task's process with SIGSTOP."""
    task = stage.find_target(entry)
    if task is not None and stage.send_signal(entry, tick, task, signal.SIGSTOP):
        task.is_stopped = True
        if task.spec.role == "host":
            # The Rack kills a stopped host board at an unknown time, for which lockstep must wait.
            stage.driver.await_state(task, lambda: task.is_lost)


def _continue_process(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Let a stopped process continue, unless it has been killed in the meantime."""
    task = stage.find_target(entry)
    if task is not None and task.is_stopped and not task.is_lost:
        with suppress(ProcessLookupError):
            os.kill(task.block[Block.PID], signal.SIGCONT)
        task.is_stopped = False
        stage.driver.wait_until_settled()


def _is_process_lost(stage: FaultStage, entry: FaultEntry) -> bool:
    """Return True if the affected process is lost."""
    task = stage.find_target(entry)
    return task is not None and task.is_lost


def _forge_message(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Publish a forged message in the mailbox of the fault."""
    entry.record_action(tick)
    forge_message(stage.segment, stage.segment.layout.mailboxes[entry.mailbox].name, tick)


def _stop_clock(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Stop this process, and with it the clock, with SIGSTOP."""
    entry.record_action(tick)
    os.kill(os.getpid(), signal.SIGSTOP)


def _skip_ticks(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Make the clock skip as many ticks as the fault's parameter specifies."""
    entry.record_action(tick)
    stage.driver.skip = int(entry.parameters[0])
    stage.driver.count_skipped(tick, stage.driver.skip)


def draw_lateness(entry: FaultEntry, tick: int) -> float:
    """Return the lateness of a tick, between the fault's parameters."""
    most, least, *_ = entry.parameters
    return random.Random(entry.seed + tick).uniform(min(least, most), most)


def _delay_tick(stage: FaultStage, entry: FaultEntry, tick: int) -> None:
    """Delay a tick by a random part of its period. In lockstep, each task computes its lateness."""
    delay = draw_lateness(entry, tick)
    entry.record_action(tick, delay > REPORTED_TICKS)
    if stage.clock.is_lockstep:
        return
    until_ns = stage.clock.compute_time_ns(tick) + int(delay * stage.clock.period_ns)
    # The delay is less than a tick period, so the clock's grid is not shifted.
    time.sleep(max(0, until_ns - time.monotonic_ns()) * 1e-9)


KILL = ClockStep(_kill_process)
HANG = ClockStep(_stop_process, end=_continue_process, is_void=_is_process_lost)
MASQUERADE = ClockStep(_forge_message)
CLOCK_STOP = ClockStep(_stop_clock)
CLOCK_SKIP = ClockStep(_skip_ticks)
CLOCK_JITTER = ClockStep(during=_delay_tick)
ELSEWHERE = ClockStep()
"""Steps of a fault that acts in another process: the clock's board does nothing."""


def _find_step(entry: FaultEntry) -> ClockStep:
    """Return the steps of a fault that the clock's board carries out.

    `ELSEWHERE` if another process carries out the fault.
    """
    step = find_kind(entry).step
    return step if isinstance(step, ClockStep) else ELSEWHERE


def _find_next_change(entry: FaultEntry, tick: int) -> int:
    """Return the first tick after `tick` at which a fault may begin or end, or `NEVER`."""
    if entry.stage == Stage.WAITING:
        return tick + 1 if entry.when_box >= 0 else max(tick + 1, entry.tick)
    if entry.stage == Stage.ACTIVE:
        kind = find_kind(entry)
        may_end_early = kind.once or _find_step(entry) is not ELSEWHERE
        # A fault that takes computing time needs each tick alone, because releases may be missed.
        takes_time = kind.where in ("load", "core")
        return tick + 1 if may_end_early or takes_time else entry.until
    return NEVER


class FaultStage:
    """Begins and ends the faults of a rack at their ticks, before any task of the tick is released.

    It also reports the first new message in each affected mailbox after a fault. In lockstep a
    process is killed or stopped between two cycles, after it has finished its release, and the run
    continues once the crate has recorded its end. A run with faults is therefore repeatable. In
    real time a fault may have a phase: it then acts at a fraction of its tick, after the releases.

    Attributes:
        injected: Number of injected faults when the fault table was last read.
        next_tick: Next tick at which a fault may begin, act or end, if no more faults are injected.
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
        """Dictionary from a mailbox's index to the tick from which a new message is awaited."""
        if self._words[System.STATE] == Run.RUNNING:
            # A restarted clock does not know which mailboxes had a new message after a fault.
            for entry in self._table.list_entries((Stage.OVER,)):
                self._await_messages(entry)
        self._phased: list[FaultEntry] = []

    def find_target(self, entry: FaultEntry) -> ReleasedTask | None:
        """Return the task or host board that a fault affects. None if it affects the clock."""
        return next((task for task in self.driver.processes if task.index == entry.task), None)

    def send_signal(
        self, entry: FaultEntry, tick: int, task: ReleasedTask, number: signal.Signals
    ) -> bool:
        """Send a signal to a task's process and record that the fault acted.

        Args:
            entry: The fault.
            tick: Current tick.
            task: Task whose process gets the signal.
            number: The signal.

        Returns:
            True if the signal was sent, False if the process does not exist.
        """
        pid = task.block[Block.PID]
        # A host board has no process if its program has finished, if it will not be restarted, or
        # in a replay.
        # A process may also have ended without the crate having noticed.
        if task.is_lost or task.block[Block.STATE] > TaskState.RUNNING or pid <= 0:
            return False
        entry.record_action(tick)
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            return False
        return True

    def advance_faults(self, tick: int) -> None:
        """Begin the faults that are due at `tick`, end the ones that are over, and set `next_tick`.

        Also report the mailboxes that have a new message after a fault.
        """
        self.injected = self._words[System.INJECTED]
        faults = self._table.list_entries((Stage.WAITING, Stage.ACTIVE))
        over = [e for e in faults if e.stage == Stage.ACTIVE and self._is_over(e, tick)]
        due = [e for e in faults if e.stage == Stage.WAITING and self._is_due(e, tick)]
        if over or due:
            # Faults must not change during a cycle, so wait until the running cycles are finished.
            self.driver.wait_until_settled()
        for entry in over:
            entry.stage = Stage.OVER
            # Faults that act once, or whose process is gone, end early.
            entry.until = min(entry.until, tick)
            self._words[System.FAULTS] += 1
            _find_step(entry).end(self, entry, tick)
            self.driver.alarms.raise_alarm(tick, Alarm.FAULT_ENDS, entry.index, entry.count)
            self._await_messages(entry)
        for entry in due:
            self._begin_fault(entry, tick)
        active = [entry for entry in faults if entry.stage == Stage.ACTIVE]
        for entry in active:
            _find_step(entry).during(self, entry, tick)
        self.driver.is_flooded = any(find_kind(entry).step is Babble for entry in active)
        for box, since_tick in list(self._awaited.items()):
            observer = self._observer(box)
            if observer.read(tick - 1).has_message and observer.newest >= since_tick:
                del self._awaited[box]
                self.driver.alarms.raise_alarm(
                    tick, Alarm.FLOWS, box, tick - since_tick, since_tick
                )
        # While messages flood the rings, do one tick at a time, so that the recorder keeps up.
        must_check = self._awaited or self.driver.is_flooded
        changes = [tick + 1] if must_check else [_find_next_change(entry, tick) for entry in faults]
        self.next_tick = min(changes, default=NEVER)

    def act_within_tick(self, tick: int) -> None:
        """Carry out the faults with a phase that begin at `tick`, each at its fraction of the tick.

        Call this after the releases of `tick`.
        """
        if not self._phased:
            return
        clock = self.clock
        for entry in sorted(self._phased, key=lambda e: e.phase):
            at_ns = clock.compute_time_ns(tick) + entry.phase * clock.period_ns // PHASES
            time.sleep(max(0, at_ns - time.monotonic_ns()) * 1e-9)
            _find_step(entry).begin(self, entry, tick)
        self._phased.clear()

    def _is_over(self, entry: FaultEntry, tick: int) -> bool:
        """Return True if an active fault must end at `tick`.

        Its duration is over, its process is gone, or it acts only once and has done so.
        """
        kind = find_kind(entry)
        has_acted = kind.once and kind.acts_in_task and entry.count > 0
        return entry.until <= tick or has_acted or _find_step(entry).is_void(self, entry)

    def _is_due(self, entry: FaultEntry, tick: int) -> bool:
        """Return True if a fault must begin at this tick.

        A condition is evaluated at every tick, so that no message is missed. It is evaluated for
        the previous tick, because the clock works ahead of the grid and messages of `tick` may not
        exist yet.
        """
        if entry.when_box < 0:
            return entry.tick <= tick
        observer = self._observer(entry.when_box)
        reading = observer.read(tick - 1)
        field = observer.spec.fields[entry.when_field].name
        return reading.has_message and int(getattr(reading.message, field)) == entry.when_value

    def _begin_fault(self, entry: FaultEntry, tick: int) -> None:
        """Activate a fault and carry it out. In real time, schedule it if it has a phase."""
        kind = find_kind(entry)
        entry.tick = tick
        duration_ticks = entry.ticks
        if kind.once and not kind.acts_in_task:
            # The clock's board carries the fault out at once, so one tick is enough. A fault that
            # acts in its task must stay active until the task's next cycle.
            duration_ticks = 1
        entry.until = tick + duration_ticks if duration_ticks else NEVER
        entry.stage = Stage.ACTIVE
        self._words[System.FAULTS] += 1
        self.driver.alarms.raise_alarm(tick, Alarm.FAULT_BEGINS, entry.index)
        if entry.phase and not self.clock.is_lockstep:
            self._phased.append(entry)
        else:
            _find_step(entry).begin(self, entry, tick)

    def _await_messages(self, entry: FaultEntry) -> None:
        """Start to watch for the first new message in each mailbox that a fault has affected."""
        layout = self.segment.layout
        if find_kind(entry).takes_mailbox:
            for box in list_affected_mailboxes(layout, entry.mailbox, find_board(entry, layout)):
                self._awaited[layout.mailboxes.index(box)] = entry.until
