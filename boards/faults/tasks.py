"""Faults of one task: in its messages, its computing time, its hardware, and on its core."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import monotonic_ns
from typing import TYPE_CHECKING, cast

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import FaultEntry, FaultTable, Stage
from rack.backplane.layout import TaskSpec
from rack.backplane.process import pin
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.faults.kind import kind_of
from rack.levels.fault_steps import Fault

if TYPE_CHECKING:
    from rack.levels.level import Executor, Planner

LEAST_S = 0.001
"""Shortest polling interval of a waiting hog."""
LOOK_S = 0.05
"""Longest polling interval of a waiting hog, which must notice that the run has stopped."""


@dataclass(frozen=True)
class ExtraComputing:
    """Extra computing time in a task's cycle. `until` is the kind's step."""

    entry: FaultEntry
    spec: TaskSpec
    clock: SystemClock
    until: LoadStep

    def burn(self, tick: int) -> None:
        """Compute until the time that the step returns."""
        now = monotonic_ns()
        self.entry.acted(tick)
        end = self.until(self, tick, now)
        while monotonic_ns() < end:
            pass

    def cycles_ns(self, cycles: float) -> int:
        """Return the length of `cycles` cycles of the task, ns."""
        return int(cycles * self.spec.every * self.clock.period_ns)


LoadStep = Callable[[ExtraComputing, int, int], int]
"""From the tick and the present time, the time at which computing ends; times are CLOCK_MONOTONIC,
ns."""


def overrun(load: ExtraComputing, tick: int, now: int) -> int:
    """Make an executor take `by` cycles longer, or a random part of that."""
    by, is_random, *_ = load.entry.parameters
    part = random.Random(load.entry.seed + tick).random() if is_random else 1.0
    return now + load.cycles_ns(part * by)


def slow_plan(load: ExtraComputing, tick: int, now: int) -> int:
    """Make a planner exceed its time slice by `by` cycles."""
    slice_end = load.clock.time_of(tick + load.spec.slice)
    return max(now, slice_end) + load.cycles_ns(load.entry.parameters[0])


class TaskFaults:
    """Applies a task's active faults: those of its writes by `apply`. `loads` are those of its
    computing time.
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
        self._index = segment.layout.processes.index(spec)
        self._apply = apply
        self._level = level
        self._clock = SystemClock(segment)
        self._arm: list[FaultEntry] = []
        self.loads: list[ExtraComputing] = []

    def refresh(self, tick: int) -> int:
        """Apply the faults that are active at `tick`; return the generation of the fault table.

        The clock works ahead of the grid: a fault that it has begun for a later tick waits for the
        next call. The generation is then -1.
        """
        generation = self._table.generation
        entries = self._table.staged((Stage.ACTIVE,))
        found = [(kind_of(entry), entry) for entry in entries if entry.task == self._index]
        active = [(kind, entry) for kind, entry in found if entry.tick <= tick]
        self.loads = [
            ExtraComputing(entry, self._spec, self._clock, kind.step)
            for kind, entry in active
            if kind.where == "load" and callable(kind.step)
        ]
        self._apply([entry for kind, entry in active if kind.where in ("writer", "lock")])
        arm = [(kind, entry) for kind, entry in active if kind.where == "arm"]
        self._arm = [entry for _, entry in arm]
        if self._spec.role == "executor":
            faults = [Fault(k.name, k.values(e), e.seed, e.tick, k.step) for k, e in arm]
            cast("Executor", self._level).inject(faults)
        return generation if len(active) == len(found) else -1

    def burn(self, tick: int) -> None:
        """Spend the extra computing time of all active faults."""
        for load in self.loads:
            load.burn(tick)

    def count(self, acted: Mapping[int, bool], tick: int) -> None:
        """Note what the arm's faults have done in a cycle: see `Executor.acted`."""
        for place, shows in acted.items():
            self._arm[place].acted(tick, shows)


def take_core(segment: Segment, entry: FaultEntry) -> None:
    """Wait until the clock begins the fault, then keep the board's core busy until the fault is
    over: a hog.

    Call it in a separate process. Raises `PermissionError` where real-time priorities are refused:
    an ordinary process cannot take a core from a board.
    """
    task = segment.layout.tasks[entry.task]
    block = segment.block(task.name)
    clock = SystemClock(segment)
    pin(block[Block.CORE])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(min(99, block[Block.PRIORITY] + 1)))
    while entry.stage == Stage.WAITING and not clock.is_stopped:
        wait_ns = clock.time_of(max(entry.tick, clock.tick + 1)) - time.monotonic_ns()
        # Wake on the clock's grid, at the first tick at which the fault can begin or at the next
        # one. If that tick has passed, or the run has not started, sleep briefly: at this priority
        # a busy wait would starve all others.
        wait_s = wait_ns * 1e-9 if wait_ns > 0 else LEAST_S
        time.sleep(min(wait_s, LOOK_S))
    end = clock.time_of(entry.until)
    entry.acted(clock.now())
    while time.monotonic_ns() < end and not clock.is_stopped:
        pass
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def act_on_core(segment: Segment, index: int) -> int:
    """Act the fault at `index` of the fault table, which takes a task's core, in a process forked
    by the crate; return the exit status.
    """
    entry = FaultTable(segment).entries[index]
    step = kind_of(entry).step
    assert callable(step), "a fault of a core has a function"
    step(segment, entry)
    return 0
