"""Tasks of the timing model: unit functions of known length, released periodically, by urgency."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

from rack.backplane.words import Scheduler

TURN_NS = 4_000_000
"""Longest time in ns that a task under ordinary scheduling runs while another waits.

One tick of a 250 Hz kernel. The time slice of Linux is 3 ms.
"""


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
        priority: SCHED_FIFO priority. A higher one preempts. Among tasks of equal priority, the
            one that has waited longest runs first, and of several the first by name. 0 stands for
            ordinary scheduling: the task yields to all others and takes turns with its like.
        every_ns: Time between two releases.
        parts: Parts of a job, in order.
        within_cycles: Number of releases that a job may span. The next job is released after them.
        ceiling: Priority of the parts that are not preemptible. A plan update blocks its executor
            and every task that has no higher priority than the executor (eq. 3.10).
        phase_ns: Time of the first release.
        due_ns: Time from a release within which its job must end. 0 for `period_ns`.
        scheduler: Its scheduler.
        is_critical: Whether maximum urgency first runs it before others.
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
    scheduler: Scheduler = Scheduler.FIXED_PRIORITY
    is_critical: bool = False

    @property
    def rank(self) -> tuple[int, bool]:
        """Key that tasks of one scheduler share. Those with a smaller one precede others."""
        is_behind = self.scheduler is Scheduler.MAXIMUM_URGENCY_FIRST and not self.is_critical
        return -self.scheduler, is_behind

    @property
    def period_ns(self) -> int:
        """Shortest time in ns between the releases of two jobs."""
        return self.every_ns * self.within_cycles

    @property
    def deadline_ns(self) -> int:
        """Time in ns from a release to the deadline of its job. Schedulers go by the period."""
        return self.due_ns or self.period_ns

    @property
    def cost_ns(self) -> int:
        """Processor time of one job in ns, without context switches."""
        return sum(part.time_ns for part in self.parts)


Urgency = tuple[Any, ...]
"""Key of a ready job. The job with the smallest key runs."""


def compute_urgency(
    scheduler: Scheduler, priority: int, deadline_ns: int, laxity_ns: int, *, is_critical: bool
) -> Urgency:
    """Return the urgency of a job under a scheduler.

    Maximum urgency first is CHIMERA's: critical tasks precede others, then the least laxity counts
    (the time that a job can still wait before it misses its deadline), then the user's priority.
    D. B. Stewart and P. K. Khosla, *Real-Time Scheduling of Sensor-Based Control Systems*, IEEE
    Workshop on Real-Time Operating Systems and Software (1991).

    Args:
        scheduler: Scheduler of the job's task.
        priority: Fixed priority of the task.
        deadline_ns: Deadline of the job.
        laxity_ns: Time from the earliest possible end of the job to its deadline.
        is_critical: Whether the task is critical.
    """
    match scheduler:
        case Scheduler.FIXED_PRIORITY:
            return -scheduler, -priority
        case Scheduler.EARLIEST_DEADLINE_FIRST:
            return -scheduler, deadline_ns, -priority
        case Scheduler.MAXIMUM_URGENCY_FIRST:
            return -scheduler, not is_critical, laxity_ns, -priority
