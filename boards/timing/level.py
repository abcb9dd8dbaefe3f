"""Timing of one board: its data for the timing model, and its times in the paper's terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

from rack.backplane.layout import TickGrid
from rack.backplane.words import Scheduler
from rack.boards.timing.tasks import Budget

Coupling = Literal["tight", "loose", "none"]


class StandbyPlace(NamedTuple):
    """Name, core and SCHED_FIFO priority of a standby."""

    name: str
    core: int
    priority: int


@dataclass(frozen=True)
class BoardTiming:
    """Data of one board for the timing model.

    Attributes:
        name: Name of the board.
        above: Boards directly above it. The relation holds if either board names the other.
        coupling: How executor and planner share processors.
        every: Period of the executor in ticks.
        due: Ticks from a release within which its cycle must end: its period, or less if it sends
            interrupts.
        within_cycles: Cycles that a plan may take.
        core: Core that the config requests for the executor.
        priority: SCHED_FIFO priority of the executor.
        planner_core: Core that the config requests for the planner.
        planner_priority: SCHED_FIFO priority of the planner.
        has_planner: Whether the level has a planner.
        is_critical: Whether the plan update is the paper's critical section, for which the executor
            has to wait.
        budget: Processor times. None if they are not known.
        plan_within_ns: Longest time for a new plan that the config accepts. None without a limit.
        queues: Queues that it reads.
        phase: Tick of the first release.
        scheduler: Scheduler of the executor.
        is_urgent: Whether maximum urgency first runs the executor before others.
        standbys: Name, core and priority of each further copy of the executor.
        reads: Ticks at which it reads messages, keyed by the board that writes them. Boards whose
            messages it reads in every cycle are left out.
    """

    name: str
    above: tuple[str, ...]
    coupling: Coupling
    every: int
    due: int
    within_cycles: int
    core: int
    priority: int
    planner_core: int
    planner_priority: int
    has_planner: bool
    is_critical: bool
    budget: Budget | None
    plan_within_ns: int | None
    queues: tuple[str, ...]
    phase: int
    scheduler: Scheduler
    is_urgent: bool
    standbys: tuple[StandbyPlace, ...]
    reads: Mapping[str, TickGrid]

    @property
    def releases(self) -> TickGrid:
        """Ticks at which its cycles begin."""
        return TickGrid(self.every, self.phase)

    @property
    def is_plan_budgeted(self) -> bool:
        """Whether the budget contains planning time.

        A budget that was measured in a run without plans does not.
        """
        return self.has_planner and self.budget is not None and self.budget.plan_ns > 0

    @property
    def exchange_ns(self) -> int:
        """Time in ns for reading the plan in each cycle. 0 without a planner or a budget."""
        return self.budget.exchange_ns if self.has_planner and self.budget is not None else 0


@dataclass(frozen=True)
class LevelTiming:
    """Worst-case times of one level in ns of the wall clock.

    Attributes:
        board: Board of the level.
        coupling: How executor and planner share processors.
        cycle_ns: R_i, the cycle of the level.
        longest_cycle_ns: R_max. See `RackTiming.longest_cycles`.
        read_ns: R, reading commands and statuses.
        execution_ns: t_exec, the processing of the executor.
        write_ns: W, writing commands and statuses.
        exchange_ns: C, reading the plan.
        plan_ns: P, making one plan. None without a planner, or if the budget has no time for it.
        update_ns: U, writing the plan.
        within_cycles: d, the cycles that a plan may take. None if `plan_ns` is None.
        plan_within_ns: Longest time for a new plan that the config accepts.
    """

    board: str
    coupling: Coupling
    cycle_ns: int
    longest_cycle_ns: int
    read_ns: int
    execution_ns: int
    write_ns: int
    exchange_ns: int
    plan_ns: int | None
    update_ns: int
    within_cycles: int | None
    plan_within_ns: int | None

    @property
    def communication_ns(self) -> int:
        """t_comm of eq. 3.5: communication of the executor in every cycle, R + W + C."""
        return self.read_ns + self.write_ns + self.exchange_ns

    @property
    def executor_planner_ns(self) -> int:
        """t_executor-planner of eqs 3.9 and 3.10: C + U. The worst cycle contains both."""
        return self.exchange_ns + self.update_ns

    @property
    def residual_ns(self) -> int:
        """t_residual of eq. 3.5, the rest of the cycle.

        It is also alpha of eq. 3.6, because the budget's times are the longest of all cycles.
        """
        return self.cycle_ns - self.execution_ns - self.communication_ns

    @property
    def planning_ns(self) -> int | None:
        """t_plan of eq. 3.8: one plan and its update, P + U. None without a planner."""
        return None if self.plan_ns is None else self.plan_ns + self.update_ns

    @property
    def slice_ns(self) -> int | None:
        """Time d R_i from a planner's release until its plan is available. None without a plan."""
        return None if self.within_cycles is None else self.within_cycles * self.cycle_ns

    def to_document(self) -> dict[str, Any]:
        """Return all times as plain data, for JSON."""
        derived = (
            "communication_ns",
            "executor_planner_ns",
            "residual_ns",
            "planning_ns",
            "slice_ns",
        )
        return asdict(self) | {name: getattr(self, name) for name in derived}
