"""The timing of one board: its data for the timing model, and its times in the paper's terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rack.backplane.layout import TickGrid
from rack.boards.timing.tasks import Budget

Coupling = Literal["tight", "loose", "none"]


@dataclass(frozen=True)
class BoardTiming:
    """One board. `every` is its cycle, `phase` its first release, in ticks; cores are those that
    the config asks for.

    `above` and `below` name each other: a board is above all that it lists below, and all that list
    it above.

    `is_critical` is true if the plan update is the paper's critical section: it keeps the executor
    waiting. `budget` is None if unknown. `plan_within_ns` is the time within which the config wants
    a new plan, wall clock. `queues` are the mailboxes in which messages wait for it. `reads` holds
    the ticks at which it reads the messages of another board, by that board, if not in every cycle.
    """

    name: str
    above: tuple[str, ...]
    below: tuple[str, ...]
    coupling: Coupling
    every: int
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
    reads: Mapping[str, TickGrid]

    @property
    def releases(self) -> TickGrid:
        """The ticks at which its cycles begin."""
        return TickGrid(self.every, self.phase)

    @property
    def is_plan_budgeted(self) -> bool:
        """Whether the budget covers its planner: in a measured run the planner may have made no
        plan.
        """
        return self.has_planner and self.budget is not None and self.budget.plan_ns > 0

    @property
    def exchange_ns(self) -> int:
        """The budget's time for reading the plan in each cycle; 0: no planner, or no budget."""
        return self.budget.exchange_ns if self.has_planner and self.budget is not None else 0


@dataclass(frozen=True)
class LevelTiming:
    """One level in the worst case, ns of the wall clock.

    `cycle_ns` is R_i, `longest_cycle_ns` is R_max (see `RackTiming.longest_cycles`). `exchange_ns`
    (C) and `update_ns` (U) pass the plan between planner and executor. `within_cycles` is d; it and
    `plan_ns` (P) are None without a planner, or if the budget does not cover it.
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
    def interlevel_ns(self) -> int:
        """t_interlevel of eq. 3.9: commands and statuses, R and W."""
        return self.read_ns + self.write_ns

    @property
    def communication_ns(self) -> int:
        """t_comm of eq. 3.5: the executor's communication in every cycle, R, W and C."""
        return self.interlevel_ns + self.exchange_ns

    @property
    def executor_planner_ns(self) -> int:
        """t_executor-planner of eqs 3.9 and 3.10: the plan read and updated, C and U, both in the
        worst cycle.
        """
        return self.exchange_ns + self.update_ns

    @property
    def residual_ns(self) -> int:
        """t_residual of eq. 3.5, and alpha of eq. 3.6: the budget's times are the longest of all
        cycles.
        """
        return self.cycle_ns - self.execution_ns - self.communication_ns

    @property
    def planning_ns(self) -> int | None:
        """t_plan of eq. 3.8: one plan and its update, P and U."""
        return None if self.plan_ns is None else self.plan_ns + self.update_ns

    @property
    def slice_ns(self) -> int | None:
        """Time from a planner's release until its plan is available: d R_i."""
        return None if self.within_cycles is None else self.within_cycles * self.cycle_ns

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        derived = (
            "communication_ns",
            "executor_planner_ns",
            "residual_ns",
            "planning_ns",
            "slice_ns",
        )
        return asdict(self) | {name: getattr(self, name) for name in derived}
