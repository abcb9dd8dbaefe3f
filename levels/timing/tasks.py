"""Tasks as the timing model sees them: unit functions of known length, released on a grid, by priority on a core."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Unit(StrEnum):
    """The unit functions of the paper's Gantt charts (section 3.4)."""

    EXCHANGE = "C"  # communication with the planner's processor: a loosely coupled executor reads its plan
    READ = "R"  # command and status
    PROCESS = "X"  # the executor
    WRITE = "W"  # command and status
    PLAN = "P"  # the planner
    UPDATE = "U"  # the plan is updated


@dataclass(frozen=True)
class Part:
    """A stretch of one unit function. One that is not preemptible runs at its task's `ceiling`."""

    unit: Unit
    time_ns: int
    preemptible: bool = True


@dataclass(frozen=True)
class TimedTask:
    """One task. Times are ns; a job is what one release, or one plan, makes it compute.

    It is released every `every_ns`, all tasks together at 0, and one job may take `within_cycles` of its cycles; the
    next job is released behind that. `priority` is SCHED_FIFO's: a higher one preempts, tasks of equal priority run
    in the order of their releases, then of `name`. Ordinary scheduling is 0, below all. `parts` are computed in order.
    `ceiling` is the priority that parts run at which are not preemptible: the plan update keeps its own executor out,
    and whoever is not above that (eq. 3.10). `jitter_ns` is how much later than its release a job may be known.
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
    jitter_ns: int = 0

    @property
    def period_ns(self) -> int:
        """The shortest time from one job's release to the next one's; also its deadline."""
        return self.every_ns * self.within_cycles

    @property
    def cost_ns(self) -> int:
        """Processor time of one job, context switches not counted."""
        return sum(part.time_ns for part in self.parts)

    @property
    def locked_ns(self) -> int:
        """The longest stretch of a job that is not preemptible."""
        return max((part.time_ns for part in self.parts if not part.preemptible), default=0)

    def time_of(self, unit: Unit) -> int:
        """Return the time that a job spends on one unit function."""
        return sum(part.time_ns for part in self.parts if part.unit is unit)
