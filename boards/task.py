"""What executor and planner tasks share: the next cycle, the control block, the trace."""

from __future__ import annotations

from time import monotonic_ns

from backplane.clock import SystemClock
from backplane.segment import Segment
from backplane.semaphores import clock_semaphore
from backplane.trace import Flag, TraceWriter
from backplane.wake import NextCycle
from backplane.words import Block, TaskState
from boards.ports import InputPorts, OutputPorts
from boards.wiring import TaskWiring

_DONE, _CYCLES, _MISSED, _SKIPPED, _LEVEL_STATE = (
    int(w) for w in (Block.DONE, Block.CYCLES, Block.MISSED, Block.SKIPPED, Block.LEVEL_STATE)
)


class Task:
    """One task on its board, behind a level's executor or planner."""

    def __init__(self, segment: Segment, wiring: TaskWiring) -> None:
        self.spec = segment.layout.task(wiring.task)
        self.block = segment.block(wiring.task)
        self.clock = SystemClock(segment)
        self.next_cycle = NextCycle(segment, wiring.task, wiring.poll)
        self.inputs = InputPorts(segment, wiring.inputs)
        self.outputs = OutputPorts(segment, wiring.outputs)
        self.trace = TraceWriter(segment, wiring.task)
        self.status = self.outputs.message("status")
        self._lockstep_clock = clock_semaphore(segment.rack) if self.clock.is_lockstep else None

    def run(self) -> None:
        """Cycle until the run is over."""
        self.block[Block.STATE] = TaskState.RUNNING
        while (tick := self.next_cycle.wait()) is not None:
            self.cycle(tick)
        self.count_bus()

    def cycle(self, tick: int) -> None:
        """Do what is released at `tick`."""
        raise NotImplementedError

    def tell_clock(self) -> None:
        """In lockstep, have the clock look at this task again."""
        if self._lockstep_clock is not None:
            self._lockstep_clock.release()

    def finish(self, tick: int, start: int, read: int, processed: int, deadline: int, in_time: bool) -> None:
        """Close a cycle: trace it, count it, say that it is done. `deadline` is a tick, the others times in ns."""
        end = monotonic_ns()
        block, skipped, lockstep = self.block, self.next_cycle.skipped, self.clock.is_lockstep
        missed = not in_time or (not lockstep and end > self.clock.time_of(deadline))
        record = self.trace.record
        record[0] = tick
        record[1] = start if lockstep else self.clock.time_of(tick)
        record[2], record[3], record[4], record[5] = start, read, processed, end
        record[6] = missed * Flag.MISSED | (skipped > 0) * Flag.SKIPPED
        record[7] = block[_LEVEL_STATE] = self.status.state if self.status is not None else 0
        self.trace.write()
        block[_CYCLES] += 1
        block[_MISSED] += missed
        block[_SKIPPED] += skipped
        block[_DONE] = tick
        self.tell_clock()
        if not block[_CYCLES] & 63:
            self.count_bus()

    def count_bus(self) -> None:
        """Bring the bus accounts of the control block up to date; not needed in every cycle."""
        readers, writers = self.inputs.readers.values(), self.outputs.writers.values()
        block = self.block
        block[Block.READS] = sum(r.accesses for r in readers)
        block[Block.READ_BYTES] = sum(r.transfers * r.spec.size for r in readers)
        block[Block.WRITES] = sum(w.serial for w in writers)
        block[Block.WRITE_BYTES] = sum(w.serial * w.spec.size for w in writers)
        block[Block.CORRUPT] = sum(r.corrupt for r in readers)
        block[Block.BUS_ERRORS] = sum(r.bus_errors for r in readers)
