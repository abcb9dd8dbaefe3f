"""Tasks of the timing model: unit functions of known length, released periodically."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


@dataclass(frozen=True)
class Budget:
    """Worst-case processor times of one level in ns. A time is 0 if the level has no such part.

    Attributes:
        read_ns: R, reading commands and statuses in one cycle.
        process_ns: X or t_exec, processing in one cycle.
        write_ns: W, writing commands and statuses in one cycle.
        exchange_ns: C, reading the plan in one cycle.
        plan_ns: P, making one plan.
        update_ns: U, writing one plan. The paper's t_plan is P + U.
    """

    read_ns: int = 0
    process_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    plan_ns: int = 0
    update_ns: int = 0


class Unit(StrEnum):
    """Unit functions of the paper's Gantt charts (section 3.4).

    Attributes:
        EXCHANGE: The executor reads the plan, which it exchanges with the planner's processor.
        READ: The executor reads commands and statuses.
        PROCESS: The executor processes.
        WRITE: The executor writes commands and statuses.
        PLAN: The planner plans.
        UPDATE: The planner writes the plan.
    """

    EXCHANGE = "C"
    READ = "R"
    PROCESS = "X"
    WRITE = "W"
    PLAN = "P"
    UPDATE = "U"


@dataclass(frozen=True)
class Part:
    """Part of a job: one unit function or one context switch.

    Attributes:
        unit: Its unit function. None for a context switch.
        time_ns: Its processor time.
        preemptible: Whether tasks of higher priority may interrupt it. If not, it runs at the
            ceiling of its task.
    """

    unit: Unit | None
    time_ns: int
    preemptible: bool = True


@dataclass(frozen=True)
class TimedTask:
    """A periodic task. Its job is the work of one release, or of one plan.

    Attributes:
        name: Name of the task.
        board: Its board.
        role: "executor", "planner" or "clock".
        core: Its core.
        priority: SCHED_FIFO priority. A higher one preempts. Tasks of equal priority run in the
            order of their releases, then of their names. 0 is ordinary scheduling, below all.
        every_ns: Time between two releases.
        parts: Parts of a job, in order.
        within_cycles: Number of releases that a job may span. The next job is released after them.
        ceiling: Priority of the parts that are not preemptible. A plan update blocks its executor
            and every task that has no higher priority than the executor (eq. 3.10).
        phase_ns: Time of the first release.
        due_ns: Time from a release within which its job must end. 0 for `period_ns`.
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
    due_ns: int = 0

    @property
    def period_ns(self) -> int:
        """Shortest time in ns between the releases of two jobs."""
        return self.every_ns * self.within_cycles

    @property
    def deadline_ns(self) -> int:
        """Time in ns from a release to the deadline of its job."""
        return self.due_ns or self.period_ns

    @property
    def cost_ns(self) -> int:
        """Processor time of one job in ns, without context switches."""
        return sum(part.time_ns for part in self.parts)
