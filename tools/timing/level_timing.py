"""The times of each level in the paper's terms, from its budget and its place in the config."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rack.backplane.layout import Layout
from rack.boards.config.schema import BoardConfig, Coupling, RackConfig
from rack.boards.config.timing import tick_ns
from rack.levels.timing.budget import Budget
from rack.levels.timing.equations import communication_ns, residual_ns
from rack.tools.timing.prediction import longest_cycles


@dataclass(frozen=True)
class LevelTiming:
    """One level in the worst case, ns of the wall clock.

    `cycle_ns` is R_i and `longest_cycle_ns` R_max, see `longest_cycles`.
    `exchange_ns` (C) and `update_ns` (U) are what executor and planner spend on passing the plan. `within_cycles` is
    d; it and `plan_ns` (P) are None where there is no planner, or none whose plans the budget tells. `plan_within_ns`
    is what the config asks for: a new plan within that time.
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
        """t_comm of eq. 3.5: what the executor communicates in every cycle, R, W and C."""
        return round(communication_ns(self.interlevel_ns, self.exchange_ns))

    @property
    def executor_planner_ns(self) -> int:
        """t_executor-planner of eqs 3.9 and 3.10: the plan read and updated, C and U, both in the worst cycle."""
        return self.exchange_ns + self.update_ns

    @property
    def residual_ns(self) -> int:
        """t_residual of eq. 3.5, and alpha of eq. 3.6: the budget's times are the longest of all cycles."""
        return round(residual_ns(self.cycle_ns, self.execution_ns, self.communication_ns))

    @property
    def planning_ns(self) -> int | None:
        """t_plan of eq. 3.8: one plan and its update, P and U."""
        return None if self.plan_ns is None else self.plan_ns + self.update_ns

    @property
    def slice_ns(self) -> int | None:
        """Time from a planner's release until its plan is there: d R_i."""
        return None if self.within_cycles is None else self.within_cycles * self.cycle_ns

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        derived = ("communication_ns", "executor_planner_ns", "residual_ns", "planning_ns", "slice_ns")
        return asdict(self) | {name: getattr(self, name) for name in derived}


def level_timings(config: RackConfig, layout: Layout, budgets: Mapping[str, Budget]) -> tuple[LevelTiming, ...]:
    """Return the timing of every level that has a budget, in the order of the config."""
    cycles = {name: layout.task(name).every * tick_ns(config) for name in config.board}
    longest = {name: round(ticks * tick_ns(config)) for name, ticks in longest_cycles(config).items()}
    return tuple(
        _timing(name, board, budgets[name], cycles[name], longest[name])
        for name, board in config.board.items()
        if name in budgets
    )


def unjudged(config: RackConfig, budgets: Mapping[str, Budget]) -> Iterator[str]:
    """Yield a line for everything that computes in a rack and of which no budget tells."""
    without = [name for name in config.board if name not in budgets]
    silent = [name for name, board in config.board.items() if name in budgets and not _plans(board, budgets[name])]
    silent = [name for name in silent if config.board[name].planner is not None]
    if without:
        names = ", ".join(without)
        yield f"not judged, nor counted on their cores, for want of a budget (in the config, or --from a run): {names}"
    if silent:
        yield f"planner not judged, for want of plan_ms in the budget: {', '.join(silent)}"
    if not config.timing.clock_ms:
        yield "the clock's board is not counted on its core: timing.clock_ms is 0"


def _timing(name: str, board: BoardConfig, budget: Budget, cycle_ns: int, longest_cycle_ns: int) -> LevelTiming:
    plans, wanted = _plans(board, budget), None if board.budget is None else board.budget.plan_within_ms
    return LevelTiming(
        board=name,
        coupling=board.coupling,
        cycle_ns=cycle_ns,
        longest_cycle_ns=longest_cycle_ns,
        read_ns=budget.read_ns,
        execution_ns=budget.process_ns,
        write_ns=budget.write_ns,
        exchange_ns=budget.exchange_ns if board.planner is not None else 0,
        plan_ns=budget.plan_ns if plans else None,
        update_ns=budget.update_ns if plans else 0,
        within_cycles=board.within_cycles if plans else None,
        plan_within_ns=round(wanted * 1e6) if plans and wanted is not None else None,
    )


def _plans(board: BoardConfig, budget: Budget) -> bool:
    """Say whether there is a planner whose plans the budget tells: in a run it may have been asked for none."""
    return board.planner is not None and budget.plan_ns > 0
