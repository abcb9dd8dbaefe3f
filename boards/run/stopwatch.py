"""The stopwatch of a task: times and traces each cycle, and keeps the counts in the task's control block.

It holds all bookkeeping around the paper's procedure: time stamps (R, X, W, C of eqs. 3.5 and 3.9), the trace record,
missed deadlines, skipped releases, failed accesses, and the report to the clock that a release is done.
"""

from __future__ import annotations

from time import monotonic_ns, process_time_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.segment import Segment
from rack.backplane.semaphores import done_semaphore
from rack.backplane.trace import FIELDS, SKIPPED_SHIFT, Flag, TraceWriter
from rack.backplane.words import Block
from rack.boards.run.ports import InputPorts, OutputPorts

# Plain integers for the hot path.
_TICK, _RELEASE, _START, _PLAN, _READ, _PROCESS, _END, _FLAGS, _STATE, _PROCESSOR = range(len(FIELDS))
_DONE, _CYCLES, _MISSED, _SKIPPED, _LEVEL_STATE, _LEVEL_SINCE, _CORRUPT, _BUS_ERRORS = (
    int(Block[name])
    for name in ("DONE", "CYCLES", "MISSED", "SKIPPED", "LEVEL_STATE", "LEVEL_SINCE", "CORRUPT", "BUS_ERRORS")
)
_MISS, _SKIP, _BUS_ERROR, _DAMAGED = (int(f) for f in (Flag.MISSED, Flag.SKIPPED, Flag.BUS_ERROR, Flag.CORRUPT))
BUS_COUNT_CYCLES = 64
"""Cycles between updates of the bus counters."""


class Stopwatch:
    """Times one task. A cycle calls `start`, then one stamp after each part, then `finish` or `idle`."""

    def __init__(self, segment: Segment, task: str, inputs: InputPorts, outputs: OutputPorts) -> None:
        self._block = segment.block(task)
        self._clock = SystemClock(segment)
        self._inputs, self._outputs = inputs, outputs
        self._status = getattr(outputs.messages, "status", None)
        self._trace = TraceWriter(segment, task)
        self._record = self._trace.record
        self._lockstep_done = done_semaphore(segment.rack, task) if self._clock.is_lockstep else None
        self._troubles = self._bus_errors = self._corrupt = self._skipped = 0
        self._processor_ns = 0  # processor time used before the current record

    def begin(self) -> None:
        """Count processor time from here on."""
        self._processor_ns = process_time_ns()

    def start(self, tick: int, skipped: int) -> None:
        """Begin the cycle released at `tick`, after `skipped` missed releases."""
        self._skipped = skipped
        self._record[_TICK] = tick
        self._record[_START] = self._record[_PLAN] = monotonic_ns()

    def exchanged(self) -> None:
        """Stamp: the plan has been transferred over the bus (C of fig. 4)."""
        self._record[_PLAN] = monotonic_ns()

    def read(self) -> None:
        """Stamp: command, status and plan are read (R)."""
        self._record[_READ] = monotonic_ns()

    def processed(self) -> None:
        """Stamp: the level has processed, or planned (X, P)."""
        self._record[_PROCESS] = monotonic_ns()

    def written(self) -> None:
        """Stamp: every output is written (W, U)."""
        self._record[_END] = monotonic_ns()

    def finish(self, in_time: bool, deadline: int, done: int, flags: int = 0) -> None:
        """Close the cycle: trace it, count it, and report all releases up to tick `done` as done.

        `in_time`: no message was too late. `deadline` is a tick.
        """
        block, record, skipped = self._block, self._record, self._skipped
        tick, missed = record[_TICK], not in_time
        lockstep_done = self._lockstep_done
        if lockstep_done is not None:
            record[_RELEASE] = record[_START]
        else:
            record[_RELEASE] = release = self._clock.time_of(tick)
            missed = missed or record[_END] > release + (deadline - tick) * self._clock.period_ns
        troubles = self._inputs.bad_reads + self._outputs.bus_errors
        if troubles != self._troubles:
            self._troubles = troubles
            flags |= self._count_troubles()
        record[_FLAGS] = flags | missed * _MISS | (skipped > 0) * _SKIP | skipped << SKIPPED_SHIFT
        state = self._status.state if self._status is not None else 0
        if state != block[_LEVEL_STATE]:
            block[_LEVEL_SINCE] = tick
        record[_STATE] = block[_LEVEL_STATE] = state
        used = process_time_ns()
        record[_PROCESSOR], self._processor_ns = used - self._processor_ns, used
        self._trace.write()
        block[_CYCLES] += 1
        block[_MISSED] += missed
        block[_SKIPPED] += skipped
        block[_DONE] = done
        if lockstep_done is not None:
            lockstep_done.release()
        if not block[_CYCLES] % BUS_COUNT_CYCLES:
            self.count_bus()

    def idle(self) -> None:
        """Close a cycle in which a planner had nothing to plan: count it, but do not trace it."""
        # Exclude its processor time from the next plan's record.
        self._processor_ns = process_time_ns()
        self._block[_CYCLES] += 1
        self._block[_DONE] = self._record[_TICK]
        self.notify_clock()

    def notify_clock(self) -> None:
        """In lockstep, let the clock check this task again."""
        if self._lockstep_done is not None:
            self._lockstep_done.release()

    def _count_troubles(self) -> int:
        """Count failed accesses since the last cycle; return trace flags."""
        bus_errors, corrupt = self._inputs.bus_errors + self._outputs.bus_errors, self._inputs.corrupt
        new_errors, new_corrupt = bus_errors - self._bus_errors, corrupt - self._corrupt
        self._bus_errors, self._corrupt = bus_errors, corrupt
        self._block[_BUS_ERRORS] += new_errors
        self._block[_CORRUPT] += new_corrupt
        return (new_errors > 0) * _BUS_ERROR | (new_corrupt > 0) * _DAMAGED

    def count_bus(self) -> None:
        """Update the bus counters of the control block; doing so in every cycle would cost too much."""
        reads, writes, block = self._inputs.take_traffic(), self._outputs.take_traffic(), self._block
        block[Block.READS] += reads[0]
        block[Block.READ_BYTES] += reads[1]
        block[Block.WRITES] += writes[0]
        block[Block.WRITE_BYTES] += writes[1]
