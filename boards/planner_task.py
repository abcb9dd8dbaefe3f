"""The planner section of the paper's algorithm: plans in the background, within its cycles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic_ns, process_time_ns

from rack.backplane.segment import Segment
from rack.backplane.trace import Flag
from rack.backplane.words import Block
from rack.boards.processor import set_priority
from rack.boards.task import Task
from rack.boards.transfer import slowed
from rack.boards.wiring import TaskWiring
from rack.levels.level import Planner


class PlannerTask(Task):
    """Runs a level's planner: asks every cycle whether a plan is wanted, and gives each plan its cycles."""

    def __init__(self, segment: Segment, wiring: TaskWiring, planner: Planner, attention: int | None = None) -> None:
        super().__init__(segment, wiring, planner, attention)
        self.planner = planner
        self.slice = self.spec.every * self.spec.within_cycles
        self._critical_priority = wiring.critical_priority
        self._priority = self.block[Block.PRIORITY]
        self._write = slowed(self.outputs.write, wiring.transfer.update_ns)

    def cycle(self, tick: int) -> None:
        """Read what the plan rests on; plan when one is wanted; write the plan."""
        start = monotonic_ns()
        self.inputs.read(tick)
        read = monotonic_ns()
        if not self.planner.wanted(self.inputs.values, tick):
            self._pass(tick, start, read)
            return
        # From here the time slice is the plan's: the clock releases nothing until its end.
        self.next_cycle.hold_until(tick + self.slice)
        self.block[Block.DEADLINE] = tick + self.slice
        self.tell_clock()
        self.planner.plan(self.inputs.values, self.outputs.messages.plan, tick)
        self.faults.burn(tick)
        processed = monotonic_ns()
        with self._critical_section():
            in_time = self._write(tick, self.clock.now(), self.inputs)
            # Behind the section the executor may have waited for its turn.
            written = monotonic_ns()
        self.block[Block.PLANS] += 1
        # A plan begun late has its whole slice: a release that had come in it by then is answered with it.
        done = max(tick, min(self.block[Block.RELEASED], tick + self.slice - self.spec.every))
        self.finish(tick, (start, start, read, processed, written), tick + self.slice, in_time, Flag.PLANNED, done)

    def _pass(self, tick: int, start: int, read: int) -> None:
        """Let a release go by without a plan; trace it when it came too late, or others were skipped."""
        self.outputs.flush(tick, self.clock.now())
        in_time = self.clock.now() < tick + self.slice
        if not in_time or self.next_cycle.skipped:
            now = monotonic_ns()
            self.finish(tick, (start, start, read, now, now), tick + self.slice, in_time)
            return
        # No part of the next plan's record.
        self.processor_ns = process_time_ns()
        self.block[Block.CYCLES] += 1
        self.block[Block.DONE] = tick
        self.tell_clock()

    @contextmanager
    def _critical_section(self) -> Iterator[None]:
        """Update the plan without being preempted by the executor: at its priority, for that long."""
        if self._critical_priority:
            set_priority(self._critical_priority)
        try:
            yield
        finally:
            if self._critical_priority:
                set_priority(self._priority)
