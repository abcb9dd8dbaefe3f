"""Stopwatch of a task: times and traces each cycle, and updates the task's control block.

It does all bookkeeping around the paper's procedure: time stamps (R, X, W, C of eqs. 3.5 and 3.9),
the trace record, counts of missed deadlines, skipped releases and failed accesses, and the report
to the clock that a release is done.
"""

from __future__ import annotations

from time import monotonic_ns, thread_time_ns

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore
from rack.backplane.trace import SKIPPED_SHIFT, Flag, TraceWriter
from rack.backplane.words import Block, System
from rack.boards.run.ports import InputPorts, OutputPorts

# Plain integers for the hot path.
_MISS, _SKIP, _BUS_ERROR, _DAMAGED = (
    int(f) for f in (Flag.MISSED, Flag.SKIPPED, Flag.BUS_ERROR, Flag.CORRUPT)
)
BUS_COUNT_CYCLES = 64
"""Number of cycles between updates of the bus counters in the control block."""


class Stopwatch:
    """Times the cycles of one task.

    A cycle calls `start_cycle`, stores a time stamp at the end of each part, and calls
    `finish_cycle` or `finish_idle_cycle`.

    Attributes:
        is_late: True if the cycle began more than half a tick late or after skipped releases, if
            the cycle before it missed its deadline, or if it is the first.
        has_missed: True if the last cycle has missed its deadline.
        late_ns: In lockstep, simulated lateness of the clock for the cycle.
        start_ns: Start of the cycle. All times are on CLOCK_MONOTONIC.
        plan_ns: End of the plan's transfer over the bus (C of fig. 4).
        read_ns: End of the reading of command, status and plan (R).
        process_ns: End of the level's `process` or `plan` (X, P).
        end_ns: End of the writing of all outputs (W, U).
        core_ns: On a simulated core, begin and end of the cycle in simulated ns since tick 0.
            The trace then has simulated times, except for the processor time.
    """

    def __init__(
        self, segment: Segment, task: str, inputs: InputPorts, outputs: OutputPorts
    ) -> None:
        self._block = segment.get_block(task)
        self._words = segment.words
        self._clock = SystemClock(segment)
        self._inputs = inputs
        self._outputs = outputs
        self._traffic = inputs.traffic + outputs.traffic
        self._reading = inputs.task
        # Byte of the level's status that contains its state. A level without a status has state 0.
        self._status = memoryview(bytes(1))
        self._state_at = 0
        if (writer := outputs.writers.get("status")) is not None:
            fields = writer.message.record.dtype.fields
            if fields and "state" in fields:
                self._status = writer.message.raw
                self._state_at = fields["state"][1]
        self._trace = TraceWriter(segment, task)
        self._lockstep_done = get_done_semaphore(segment, task) if self._clock.is_lockstep else None
        self._troubles = self._bus_errors = self._corrupt = 0
        self._cycles = self._block[Block.CYCLES]
        self._state = self._block[Block.LEVEL_STATE]
        self._processor_ns = 0  # processor time used before the current record
        self._closed_ns = 0  # end of the bookkeeping of the last cycle
        self._period_ns = self._clock.period_ns
        self._tick = self._skipped = 0
        self._late_ns = self._period_ns // 2
        self._release_ns = 0  # grid point of the tick, in lockstep the start without `late_ns`
        self.is_late = True
        self.has_missed = False
        self.late_ns = 0
        self.core_ns: tuple[int, int] | None = None
        self.start_ns = self.plan_ns = self.read_ns = self.process_ns = self.end_ns = 0

    def start_counting(self) -> None:
        """Start to measure the processor time that the next trace record contains."""
        self._processor_ns = thread_time_ns()

    def start_cycle(self, tick: int, skipped: int) -> None:
        """Begin the cycle released at `tick`, before which `skipped` releases were skipped."""
        self._tick = tick
        self._skipped = skipped
        self.start_ns = self.plan_ns = release_ns = start_ns = monotonic_ns()
        if self._lockstep_done is None:
            release_ns = self._words[System.EPOCH_NS] + tick * self._period_ns
        else:
            release_ns -= self.late_ns
        self._release_ns = release_ns
        self.is_late = (
            skipped > 0
            or start_ns - release_ns > self._late_ns
            or self.has_missed
            or not self._closed_ns
        )

    def find_late_tick(self, deadline: int) -> int | None:
        """Return the current tick if it is `deadline` or later, otherwise None.

        Call this at the end of the level's `process`, after setting `process_ns`.

        Args:
            deadline: Tick before which the cycle must end.
        """
        if self._lockstep_done is None and self.process_ns < self._compute_time_ns(deadline):
            return None
        now = self._clock.compute_tick()
        return now if now >= deadline else None

    def finish_cycle(self, in_time: bool, deadline: int, done: int, flags: int = 0) -> None:
        """Close the cycle: trace it, count it, and report its release as done.

        Args:
            in_time: False if a message was published too late.
            deadline: Tick before which the cycle had to end.
            done: Newest release that is done.
            flags: Additional flags for the trace record.
        """
        block = self._block
        tick = self._tick
        skipped = self._skipped
        lockstep_done = self._lockstep_done
        self.has_missed = is_missed = not in_time or (
            lockstep_done is None and self.end_ns > self._compute_time_ns(deadline)
        )
        if self._reading.troubles != self._troubles or not in_time:
            flags |= self._count_troubles()
        if is_missed:
            flags |= _MISS
            block[Block.MISSED] += 1
        if skipped:
            flags |= _SKIP | skipped << SKIPPED_SHIFT
            block[Block.SKIPPED] += skipped
        state = self._status[self._state_at]
        if state != self._state:
            self._state = block[Block.LEVEL_STATE] = state
            block[Block.LEVEL_SINCE] = tick
        if self.core_ns is not None:
            self._simulate_stamps(*self.core_ns)
        used_ns = thread_time_ns()
        self._trace.write(
            tick,
            self._release_ns,
            self.start_ns,
            self.plan_ns,
            self.read_ns,
            self.process_ns,
            self.end_ns,
            flags,
            state,
            used_ns - self._processor_ns,
            self._closed_ns,
        )
        self._processor_ns = used_ns
        self._cycles = block[Block.CYCLES] = self._cycles + 1
        if not self._cycles % BUS_COUNT_CYCLES:
            # In lockstep the clock may kill this process as soon as its release is done.
            self.update_bus_counters()
        block[Block.DONE] = done
        if lockstep_done is not None and (is_missed or done >= block[Block.RELEASED]):
            # This was the last release of a batch, or the clock waits for a late cycle.
            lockstep_done.release()
        self._closed_ns = monotonic_ns()

    def _simulate_stamps(self, begin_ns: int, end_ns: int) -> None:
        """Replace the time stamps of the cycle by those on a simulated core.

        Reading and writing take their real times, as far as the simulated time is long enough.

        Args:
            begin_ns: Begin of the cycle in simulated ns since tick 0.
            end_ns: Its end.
        """
        epoch_ns = self._words[System.EPOCH_NS]
        wrote_ns = self.end_ns - self.process_ns
        later_ns = epoch_ns + begin_ns - self.start_ns
        self._release_ns = epoch_ns + self._tick * self._period_ns
        self.end_ns = end_ns = epoch_ns + end_ns
        self.start_ns += later_ns
        self.plan_ns = min(self.plan_ns + later_ns, end_ns)
        self.read_ns = min(self.read_ns + later_ns, end_ns)
        self.process_ns = max(self.read_ns, end_ns - wrote_ns)

    def _compute_time_ns(self, tick: int) -> int:
        """Return the grid point of a tick, in ns of CLOCK_MONOTONIC."""
        return self._release_ns + (tick - self._tick) * self._period_ns

    def finish_idle_cycle(self) -> None:
        """Close a cycle in which no plan was wanted. It is counted but not traced."""
        # Exclude its processor time from the next plan's record.
        self._processor_ns = thread_time_ns()
        self._cycles = self._block[Block.CYCLES] = self._cycles + 1
        self._block[Block.DONE] = self._tick
        self.notify_clock()

    def notify_clock(self) -> None:
        """In lockstep, wake the clock so that it checks the state of this task again."""
        if self._lockstep_done is not None:
            self._lockstep_done.release()

    def _count_troubles(self) -> int:
        """Add accesses that have failed since the last call to the counts in the control block.

        Returns:
            Flags for the trace record: `Flag.BUS_ERROR` and `Flag.CORRUPT` as they apply.
        """
        self._troubles = self._reading.troubles
        bus_errors = self._inputs.bus_errors + self._outputs.bus_errors
        corrupt = self._inputs.corrupt
        new_errors = bus_errors - self._bus_errors
        new_corrupt = corrupt - self._corrupt
        self._bus_errors = bus_errors
        self._corrupt = corrupt
        self._block[Block.BUS_ERRORS] += new_errors
        self._block[Block.CORRUPT] += new_corrupt
        return (new_errors > 0) * _BUS_ERROR | (new_corrupt > 0) * _DAMAGED

    def update_bus_counters(self) -> None:
        """Update the counts of accesses and bytes in the control block.

        This is not done in every cycle, because it takes too long.
        """
        before = self._traffic
        self._traffic = self._inputs.traffic + self._outputs.traffic
        words = (Block.READS, Block.READ_BYTES, Block.WRITES, Block.WRITE_BYTES)
        for word, count, counted in zip(words, self._traffic, before, strict=True):
            self._block[word] += count - counted
