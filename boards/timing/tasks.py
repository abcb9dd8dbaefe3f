"""Budgets of levels, and tasks of the timing model: unit functions of known length, released on a
grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


@dataclass(frozen=True)
class Budget:
    """Worst-case processor times of one level, ns; 0 if a level has no such part.

    `read_ns` (R), `process_ns` (X, t_exec), `write_ns` (W) and `exchange_ns` (C, reading the plan)
    are of one cycle of the executor. `plan_ns` (P) and `update_ns` (U) are of one plan; the paper's
    t_plan is their sum.
    """

    read_ns: int = 0
    process_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    plan_ns: int = 0
    update_ns: int = 0


class Unit(StrEnum):
    """The unit functions of the paper's Gantt charts (section 3.4)."""

    # communication with the planner's processor: a loosely coupled executor reads its plan
    EXCHANGE = "C"
    READ = "R"  # command and status
    PROCESS = "X"  # the executor
    WRITE = "W"  # command and status
    PLAN = "P"  # the planner
    UPDATE = "U"  # the plan is updated


@dataclass(frozen=True)
class Part:
    """A stretch of one unit function; None: a context switch. A part that is not preemptible runs
    at its task's `ceiling`.
    """

    unit: Unit | None
    time_ns: int
    preemptible: bool = True


@dataclass(frozen=True)
class TimedTask:
    """One task; all times in ns. A job is the work of one release, or of one plan.

    The task is released every `every_ns`, first at `phase_ns`. A job may take `within_cycles`
    cycles; the next job is released after those. `parts` are computed in order. `priority` is
    SCHED_FIFO's: a higher one preempts; tasks of equal priority run in the order of their releases,
    then of `name`. Ordinary scheduling is 0, below all. `ceiling` is the priority of parts that are
    not preemptible: a plan update blocks its own executor and every task that is not above the
    executor (eq. 3.10).
    """

    name: str
    board: str
    role: Literal["executor", "planner", "clock"]
    core: int
    priority: int
    every_ns: int
    parts: tuple[Part, ...]
    within_cycles: int = 1
    ceiling: int = 0
    phase_ns: int = 0

    @property
    def period_ns(self) -> int:
        """The shortest time between the releases of two jobs; also a job's deadline."""
        return self.every_ns * self.within_cycles

    @property
    def cost_ns(self) -> int:
        """Processor time of one job, without context switches."""
        return sum(part.time_ns for part in self.parts)
