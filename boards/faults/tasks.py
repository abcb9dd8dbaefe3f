"""Faults of one task: its messages, its computing time, its hardware and its core."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import monotonic_ns, sleep
from typing import TYPE_CHECKING, cast

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import FaultEntry, FaultTable, Stage
from rack.backplane.layout import TaskSpec
from rack.backplane.process import pin_to_core, set_priority
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.faults.clock_board import CLOCK_JITTER, draw_lateness
from rack.boards.faults.kind import find_kind
from rack.levels.fault_steps import Fault

if TYPE_CHECKING:
    from rack.levels.level import Executor, Planner

MIN_POLL_S = 0.001
"""Shortest polling interval of a waiting hog."""
MAX_POLL_S = 0.05
"""Longest polling interval of a waiting hog, which must notice the end of the run."""


@dataclass(frozen=True)
class ExtraComputing:
    """Extra computing time in a task's cycle.

    Attributes:
        entry: The fault.
        spec: The affected task.
        clock: System clock of the rack.
        until: Step of the kind, which computes when the extra computing ends.
    """

    entry: FaultEntry
    spec: TaskSpec
    clock: SystemClock
    until: LoadStep

    def burn_time(self, tick: int) -> None:
        """Record that the fault acted, and keep the processor busy until the time from `until`."""
        now_ns = monotonic_ns()
        self.entry.record_action(tick)
        end_ns = self.until(self, tick, now_ns)
        while monotonic_ns() < end_ns:
            pass

    def cycles_ns(self, cycles: float) -> int:
        """Return the length of `cycles` cycles of the task in ns."""
        return int(cycles * self.spec.every * self.clock.period_ns)


LoadStep = Callable[[ExtraComputing, int, int], int]
"""Computes the time at which extra computing ends from the load, the tick and the current time.

Times are CLOCK_MONOTONIC in ns, in lockstep as if ticks had their length in real time.
"""


def compute_cycle_end(load: ExtraComputing, tick: int, now_ns: int) -> int:
    """Compute when extra computing of `by` cycles, or of a random fraction of this time, ends.

    Args:
        load: The extra computing; its fault has the parameters `by` and `random`.
        tick: Release of the cycle.
        now_ns: Current time in ns.

    Returns:
        Time in ns at which the computing ends.
    """
    by, is_random, *_ = load.entry.parameters
    fraction = random.Random(load.entry.seed + tick).random() if is_random else 1.0
    return now_ns + load.cycles_ns(fraction * by)


def compute_slice_end(load: ExtraComputing, tick: int, now_ns: int) -> int:
    """Compute when extra computing that exceeds a planner's time slice by `by` cycles ends.

    Args:
        load: The extra computing; its fault has the parameter `by`.
        tick: Release of the slice.
        now_ns: Current time in ns.

    Returns:
        Time in ns at which the computing ends.
    """
    slice_end = load.clock.compute_time_ns(tick + load.spec.slice)
    return max(now_ns, slice_end) + load.cycles_ns(load.entry.parameters[0])


class TaskFaults:
    """Applies the active faults of one task.

    Args:
        segment: Segment of the rack.
        spec: The task.
        apply: Called with the faults of the task's messages.
        level: Executor or planner of the task.

    Attributes:
        loads: Extra computing of the active faults.
        taken_until: In lockstep, tick until which faults take the core from this task.
    """

    def __init__(
        self,
        segment: Segment,
        spec: TaskSpec,
        apply: Callable[[Sequence[FaultEntry]], None],
        level: Executor | Planner,
    ) -> None:
        self._table = FaultTable(segment)
        self._spec = spec
        self._tasks = segment.layout.tasks
        self._index = segment.layout.processes.index(spec)
        self._apply = apply
        self._level = level
        self._clock = SystemClock(segment)
        self._arm: list[FaultEntry] = []
        self.loads: list[ExtraComputing] = []
        self.taken_until = 0
        self._late_ticks: list[FaultEntry] = []

    def refresh_faults(self, tick: int) -> int:
        """Apply the faults that are active at `tick`.

        Returns:
            Generation of the fault table, so that the caller can skip this call while it is
            unchanged. -1 if a fault is marked as active but begins at a later tick, which happens
            because the clock works ahead of the grid. The next cycle must then call this again. In
            lockstep also -1 while ticks are late, because each has another lateness.
        """
        generation = self._table.generation
        entries = self._table.list_entries((Stage.ACTIVE,))
        if self._clock.is_lockstep:
            self._refresh_simulated_faults(entries, tick)
        begun = [
            entry
            for entry in entries
            # A fault of the arm strikes what all copies of a task simulate.
            if entry.task == self._index
            or (
                find_kind(entry).where == "arm"
                and self._tasks[entry.task].board == self._spec.board
            )
        ]
        active = [(find_kind(entry), entry) for entry in begun if entry.tick <= tick]
        self.loads = [
            ExtraComputing(entry, self._spec, self._clock, kind.step)
            for kind, entry in active
            if kind.where == "load" and callable(kind.step)
        ]
        self._apply([entry for kind, entry in active if kind.where in ("writer", "copy", "lock")])
        self._arm = [entry for kind, entry in active if kind.where == "arm"]
        if self._spec.role != "planner":
            cast("Executor", self._level).inject(
                [
                    Fault(kind.name, kind.read_parameters(entry), entry.seed, entry.tick, kind.step)
                    for kind, entry in active
                    if kind.where == "arm"
                ]
            )
        return generation if len(active) == len(begun) and not self._late_ticks else -1

    def _refresh_simulated_faults(self, entries: Sequence[FaultEntry], tick: int) -> None:
        """Find the active faults of the core and the clock, which act in each task in lockstep."""
        spec = self._spec
        self.taken_until = 0
        self._late_ticks = []
        for entry in entries:
            kind = find_kind(entry)
            if kind.where == "core" and entry.task >= 0:
                struck = self._tasks[entry.task]
                if struck.core == spec.core and struck.priority >= spec.priority:
                    self.taken_until = max(self.taken_until, entry.until)
                    if struck is spec:
                        entry.record_action(tick)
            elif kind.step is CLOCK_JITTER:
                self._late_ticks.append(entry)

    def find_lateness(self, tick: int) -> float:
        """In lockstep, return by how many ticks the clock begins `tick` late."""
        return max((draw_lateness(entry, tick) for entry in self._late_ticks), default=0.0)

    def burn_time(self, tick: int) -> None:
        """In real time, keep the processor busy for each active fault in turn."""
        if not self._clock.is_lockstep:
            for load in self.loads:
                load.burn_time(tick)

    def extend_computing(self, tick: int, begin_ns: int, end_ns: int) -> int:
        """In lockstep, return the end of the computing with the active faults.

        This is a `rack.boards.run.simulated_time.FinishStep`.

        Args:
            tick: Release tick of the cycle.
            begin_ns: Begin of the cycle.
            end_ns: End of the cycle without the faults.
        """
        epoch_ns = self._clock.compute_time_ns(0)
        for load in self.loads:
            load.entry.record_action(tick)
            end_ns = load.until(load, tick, epoch_ns + end_ns) - epoch_ns
        return end_ns

    def count_actions(self, acted: Mapping[int, bool], tick: int) -> None:
        """Record which faults of the arm acted in the cycle released at `tick`.

        `acted` maps the index of a fault in the list of the arm's faults to True if its effect must
        be detected: see `Executor.acted`.
        """
        for index, shows in acted.items():
            self._arm[index].record_action(tick, shows)


def take_core(segment: Segment, entry: FaultEntry) -> None:
    """Keep the core of a board busy while a fault is active (a hog).

    Waits until the clock begins the fault. Call it in a separate process.

    Raises:
        PermissionError: Real-time priorities are not permitted. An ordinary process cannot take a
            core from a board.
    """
    task = segment.layout.tasks[entry.task]
    block = segment.get_block(task.name)
    clock = SystemClock(segment)
    pin_to_core(block[Block.CORE])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(min(99, block[Block.PRIORITY] + 1)))
    while entry.stage == Stage.WAITING and not clock.is_stopped:
        wait_ns = clock.compute_time_ns(max(entry.tick, clock.tick + 1)) - monotonic_ns()
        # Wake on the clock's grid, at the first tick at which the fault can begin or at the next
        # one. If that tick has passed, or the run has not started, sleep briefly, because at this
        # priority a busy wait would starve all other processes.
        wait_s = wait_ns * 1e-9 if wait_ns > 0 else MIN_POLL_S
        sleep(min(wait_s, MAX_POLL_S))
    end = clock.compute_time_ns(entry.until)
    entry.record_action(clock.compute_tick())
    while monotonic_ns() < end and not clock.is_stopped:
        pass
    set_priority(0)


def run_core_fault(segment: Segment, index: int) -> int:
    """Carry out the fault at `index` of the fault table, which takes a task's core.

    Called in a process that the crate has forked, or by `rack inject`. Returns exit status 0.
    """
    entry = FaultTable(segment).entries[index]
    step = find_kind(entry).step
    assert callable(step), "a fault of a core has a function"
    step(segment, entry)
    return 0
