"""A task on its board: the common part of the executor's and the planner's loop, and the clock guard of fast tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from time import process_time_ns
from typing import ParamSpec, TypeVar

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.clock.wake import NextCycle
from rack.backplane.mailbox.interrupt import open_inbox
from rack.backplane.process import compute_until
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import Block, System, TaskState
from rack.boards.faults.tasks import TaskFaults
from rack.boards.run.interrupts import InterruptHandler
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.boards.run.stopwatch import Stopwatch
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner

# Plain integers for the hot path.
_FAULTS, _TICK_NS, _TICK, _CLOCK_SKIPPED = (
    int(word) for word in (System.FAULTS, System.TICK_NS, System.TICK, System.CLOCK_SKIPPED)
)
PUNCTUAL_TICKS = 20
"""Number of punctual ticks that ends an episode of late ones."""
_P = ParamSpec("_P")
_R = TypeVar("_R")


class Task(ABC):
    """One task around a level's executor or planner: ports, clock, stopwatch and faults."""

    def __init__(
        self, segment: Segment, wiring: TaskWiring, level: Executor | Planner, attention: int | None = None
    ) -> None:
        self.spec = spec = segment.layout.task(wiring.task)
        self.block = segment.block(wiring.task)
        self.words = segment.words
        self.clock = SystemClock(segment)
        self.alarms = AlarmWriter(segment, wiring.task, attention)
        self.next_cycle = NextCycle(segment, wiring.task, self.alarms if wiring.guards_clock else None)
        inbox = open_inbox(segment, wiring.task)
        self.interrupts = InterruptHandler.of(segment, wiring.task, inbox, self.alarms)
        self.inputs = InputPorts(
            segment,
            wiring.inputs,
            self.alarms,
            f"{spec.board}.plan",
            room=level.room,
            exchange=wiring.exchange,
            inbox=inbox,
        )
        self.inputs.task.now = self.clock.now
        self.outputs = OutputPorts(segment, wiring.outputs, self.alarms, self.inputs, wiring.sent)
        self.stopwatch = Stopwatch(segment, wiring.task, self.inputs, self.outputs)
        self.faults = TaskFaults(segment, spec, self.outputs, level)
        self._generation = 0

    def begin(self) -> None:
        """Mark the task as running on the backplane, and start to count its processor time."""
        self.block[Block.STATE] = TaskState.RUNNING
        self.stopwatch.begin()

    def wait_until_next_cycle(self) -> int | None:
        """Wait for the next release and return its tick; None when the run is over.

        Between cycles, here, faults take effect.
        """
        tick = self.next_cycle.wait()
        if tick is None:
            return None
        if self.words[_FAULTS] != self._generation:
            self._generation = self.faults.refresh(tick)
        return tick

    @abstractmethod
    def run(self) -> None:
        """Cycle until the run is over."""


class ClockGuard:
    """A fast task's check of the clock, whenever a cycle begins late: did the clock release it late, or skip ticks?

    A missing release counts as skipped by the clock, not by the task, if the clock has counted it as skipped.
    """

    def __init__(self, segment: Segment, alarms: AlarmWriter, every: int) -> None:
        self._words = segment.words
        self._clock = SystemClock(segment)
        self._alarms, self._every = alarms, every
        self._late_ns = self._clock.period_ns // 2
        self._skipped = self._words[_CLOCK_SKIPPED]
        self._quiet_from = 0

    def check(self, tick: int, skipped: int) -> None:
        """Check the clock in the cycle released at `tick`, after `skipped` missed releases."""
        words = self._words
        # Ticks skipped earlier cost the task no release.
        by_clock = min(words[_CLOCK_SKIPPED] - self._skipped, skipped * self._every)
        self._skipped = words[_CLOCK_SKIPPED]
        if by_clock:
            self._alarms.ring(tick, Alarm.CLOCK_SKIPPED, value=by_clock, since=tick - by_clock)
        late_ns = words[_TICK_NS] - self._clock.time_of(tick)
        # Checked after the read: the time is this tick's only if the clock has not advanced meanwhile.
        if self._clock.is_lockstep or words[_TICK] != tick:
            return
        if late_ns > self._late_ns:
            if tick >= self._quiet_from:
                self._alarms.ring(tick, Alarm.CLOCK_LATE, value=late_ns)
            self._quiet_from = tick + PUNCTUAL_TICKS


def slowed(access: Callable[_P, _R], time_ns: int) -> Callable[_P, _R]:
    """Return `access`, extended to at least `time_ns` of processor time; `access` itself if that is 0.

    This emulates a slower bus: programmed transfers over VME occupied the processor.
    """
    if not time_ns:
        return access

    def take(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        end = process_time_ns() + time_ns
        result = access(*args, **kwargs)
        compute_until(end)
        return result

    return take
