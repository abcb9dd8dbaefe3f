"""What executor and planner tasks share: the next cycle, the control block, the trace."""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import process_time_ns

from rack.backplane.alarms import AlarmWriter
from rack.backplane.clock import SystemClock
from rack.backplane.segment import Segment
from rack.backplane.semaphores import clock_semaphore
from rack.backplane.trace import SKIPPED_SHIFT, Flag, TraceWriter
from rack.backplane.wake import NextCycle
from rack.backplane.words import Block, System, TaskState
from rack.boards.clock_guard import ClockGuard
from rack.boards.faults.tasks import TaskFaults
from rack.boards.ports import InputPorts, OutputPorts
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner

# Plain integers for the hot path.
_DONE, _CYCLES, _MISSED, _SKIPPED, _LEVEL_STATE, _LEVEL_SINCE, _CORRUPT, _BUS_ERRORS = (
    int(Block[name])
    for name in ("DONE", "CYCLES", "MISSED", "SKIPPED", "LEVEL_STATE", "LEVEL_SINCE", "CORRUPT", "BUS_ERRORS")
)
_FAULTS = int(System.FAULTS)
_MISS, _SKIP, _BUS_ERROR, _DAMAGED = (int(f) for f in (Flag.MISSED, Flag.SKIPPED, Flag.BUS_ERROR, Flag.CORRUPT))


class Task(ABC):
    """One task on its board, behind a level's executor or planner."""

    def __init__(
        self, segment: Segment, wiring: TaskWiring, level: Executor | Planner, attention: int | None = None
    ) -> None:
        self.spec = spec = segment.layout.task(wiring.task)
        self.block = segment.block(wiring.task)
        self.words = segment.words
        self.clock = SystemClock(segment)
        self.alarms = AlarmWriter(segment, wiring.task, attention)
        self.next_cycle = NextCycle(segment, wiring.task, wiring.poll, self.alarms if wiring.guards_clock else None)
        self.inputs = InputPorts(segment, wiring.inputs, self.alarms, f"{self.spec.board}.plan")
        self.outputs = OutputPorts(segment, wiring.outputs, self.alarms)
        self.faults = TaskFaults(segment, spec, self.outputs, level)
        self._generation = 0
        self._guard = ClockGuard(segment, spec, self.alarms) if wiring.guards_clock else None
        self.trace = TraceWriter(segment, wiring.task)
        self.status = self.outputs.message("status")
        self._bus_errors = self._corrupt = 0
        self.processor_ns = 0  # used before the next record begins
        self._lockstep_clock = clock_semaphore(segment.rack) if self.clock.is_lockstep else None

    def run(self) -> None:
        """Cycle until the run is over."""
        self.block[Block.STATE] = TaskState.RUNNING
        self.processor_ns = process_time_ns()
        words = self.words
        while (tick := self.next_cycle.wait()) is not None:
            if words[_FAULTS] != self._generation:
                self._generation = self.faults.refresh()
            if self._guard is not None:
                self._guard.look(tick, self.next_cycle.skipped)
            self.cycle(tick)
        self.count_bus()

    @abstractmethod
    def cycle(self, tick: int) -> None:
        """Do what is released at `tick`."""

    def tell_clock(self) -> None:
        """In lockstep, have the clock look at this task again."""
        if self._lockstep_clock is not None:
            self._lockstep_clock.release()

    def finish(
        self,
        tick: int,
        times: tuple[int, int, int, int, int],
        deadline: int,
        in_time: bool,
        flags: int = 0,
        done: int | None = None,
    ) -> None:
        """Close a cycle: trace it, count it, say that it is done, with `done` all releases up to that tick.

        `times` are those at which it began, had read its plan, had read everything, had processed, and had written, ns.
        `deadline` and `done` are ticks.
        """
        block, skipped, lockstep = self.block, self.next_cycle.skipped, self.clock.is_lockstep
        missed = not in_time or (not lockstep and times[4] > self.clock.time_of(deadline))
        record = self.trace.record
        record[0] = tick
        record[1] = times[0] if lockstep else self.clock.time_of(tick)
        record[2], record[3], record[4], record[5], record[6] = times
        record[7] = flags | missed * _MISS | (skipped > 0) * _SKIP | skipped << SKIPPED_SHIFT | self._trouble()
        state = self.status.state if self.status is not None else 0
        if state != block[_LEVEL_STATE]:
            block[_LEVEL_SINCE] = tick
        record[8] = block[_LEVEL_STATE] = state
        used = process_time_ns()
        record[9], self.processor_ns = used - self.processor_ns, used
        self.trace.write()
        block[_CYCLES] += 1
        block[_MISSED] += missed
        block[_SKIPPED] += skipped
        block[_DONE] = tick if done is None else done
        self.tell_clock()
        if not block[_CYCLES] & 63:
            self.count_bus()

    def _trouble(self) -> int:
        """Count what went wrong on the bus since the last cycle; return it as trace flags."""
        bus_errors, corrupt = self.inputs.bus_errors + self.outputs.bus_errors, self.inputs.corrupt
        new_errors, new_corrupt = bus_errors - self._bus_errors, corrupt - self._corrupt
        self._bus_errors, self._corrupt = bus_errors, corrupt
        self.block[_BUS_ERRORS] += new_errors
        self.block[_CORRUPT] += new_corrupt
        return (new_errors > 0) * _BUS_ERROR | (new_corrupt > 0) * _DAMAGED

    def count_bus(self) -> None:
        """Bring the bus accounts of the control block up to date; not needed in every cycle."""
        reads, writes, block = self.inputs.take_traffic(), self.outputs.take_traffic(), self.block
        block[Block.READS] += reads[0]
        block[Block.READ_BYTES] += reads[1]
        block[Block.WRITES] += writes[0]
        block[Block.WRITE_BYTES] += writes[1]
