"""A config in the terms of the timing model: the budgets of its levels, and the tasks that they make."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, Role, TaskSpec
from rack.boards.config.mistakes import PLANNER_BUDGET
from rack.boards.config.schema import BoardConfig, BudgetConfig, RackConfig
from rack.levels.timing.budget import Budget
from rack.levels.timing.tasks import Part, TimedTask, Unit

NS_PER_MS = 1e6
PARTS = tuple(field.name for field in fields(Budget))


def budgets(config: RackConfig) -> dict[str, Budget]:
    """Return the budgets that the config gives, by board; boards without one are left out."""
    tables = {name: board.budget for name, board in config.board.items()}
    return {
        name: Budget(**{key: round(getattr(table, f"{key.removesuffix('_ns')}_ms") * NS_PER_MS) for key in PARTS})
        for name, table in tables.items()
        if table is not None
    }


def with_budgets(config: RackConfig, found: Mapping[str, Budget]) -> RackConfig:
    """Return a config that gives these budgets, by board, and no others; how soon it wants plans stays."""
    boards = {name: _budgeted(board, found.get(name)) for name, board in config.board.items()}
    return config.model_copy(update={"board": boards})


def _budgeted(board: BoardConfig, budget: Budget | None) -> BoardConfig:
    wanted = None if board.budget is None else board.budget.plan_within_ms
    if budget is None:
        return board.model_copy(update={"budget": None})
    times = {f"{part.removesuffix('_ns')}_ms": time_ns / NS_PER_MS for part, time_ns in asdict(budget).items()}
    if board.planner is None:
        times = {key: time for key, time in times.items() if key not in PLANNER_BUDGET}
    return board.model_copy(update={"budget": BudgetConfig(**times, plan_within_ms=wanted)})


def timed_tasks(config: RackConfig, layout: Layout, found: Mapping[str, Budget]) -> tuple[TimedTask, ...]:
    """Return the clock's task and those of every board that has a budget, on the cores that the config asks for.

    Times are of the wall clock: with a speed factor the cycles are shorter, the budgets are not.
    """
    tasks = [_task(config, layout, task, found[task.board]) for task in layout.tasks if task.board in found]
    return (*_clock(config), *tasks)


def tick_ns(config: RackConfig) -> int:
    """Return one tick of the wall clock, ns."""
    return round(config.clock_ns / config.clock.speed)


def is_critical(config: RackConfig, layout: Layout, board: str) -> bool:
    """Say whether a board's plan update is the paper's critical section: tightly coupled, under protocol lock."""
    return config.board[board].coupling == "tight" and layout.mailbox(f"{board}.plan").protocol == "lock"


def asked_core(board: BoardConfig, role: Role) -> int:
    """Return the core that the config asks for, whether or not this machine has it."""
    return board.core if role == "executor" or board.planner_core is None else board.planner_core


def _clock(config: RackConfig) -> Iterator[TimedTask]:
    time_ns = round(config.timing.clock_ms * NS_PER_MS)
    if time_ns:
        parts, clock = (Part(Unit.PROCESS, time_ns),), config.clock
        yield TimedTask(CLOCK, CLOCK, "clock", clock.core, clock.priority, tick_ns(config), parts)


def _task(config: RackConfig, layout: Layout, task: TaskSpec, budget: Budget) -> TimedTask:
    board = config.board[task.board]
    is_planner = task.role == "planner"
    critical = is_planner and is_critical(config, layout, task.board)
    return TimedTask(
        name=task.name,
        board=task.board,
        role=task.role,
        core=asked_core(board, task.role),
        priority=task.priority,
        every_ns=task.every * tick_ns(config),
        parts=_planner_parts(budget, critical) if is_planner else _executor_parts(budget, board),
        within_cycles=task.within_cycles,
        ceiling=board.priority if critical else 0,
    )


def _executor_parts(budget: Budget, board: BoardConfig) -> tuple[Part, ...]:
    parts = (
        Part(Unit.EXCHANGE, budget.exchange_ns if board.planner is not None else 0),
        Part(Unit.READ, budget.read_ns),
        Part(Unit.PROCESS, budget.process_ns),
        Part(Unit.WRITE, budget.write_ns),
    )
    return tuple(part for part in parts if part.time_ns)


def _planner_parts(budget: Budget, critical: bool) -> tuple[Part, ...]:
    parts = Part(Unit.PLAN, budget.plan_ns), Part(Unit.UPDATE, budget.update_ns, preemptible=not critical)
    return tuple(part for part in parts if part.time_ns)
