"""Inputs of the timing model, from a config and its layout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, TickGrid
from rack.backplane.mailbox.interrupt import get_interrupt_spec, list_sources
from rack.boards.config.command import CommandConfig
from rack.boards.config.schedulers import find_clock_scheduler, find_scheduler
from rack.boards.config.schema import (
    RackConfig,
)
from rack.boards.config.times import BudgetConfig, ScheduleConfig
from rack.boards.faults.config import FaultConfig
from rack.boards.timing.interrupts import InboxTiming
from rack.boards.timing.level import BoardTiming, StandbyPlace
from rack.boards.timing.rack import CyclicSchedule, RackTiming
from rack.boards.timing.tasks import Budget, Part, TimedTask, Unit

NS_PER_MS = 1e6
KEYS = {part.name: part.name.replace("_ns", "_ms") for part in fields(Budget)}
"""Key in a config for each field of a `Budget`."""
PLANNER_BUDGET = ("exchange_ms", "plan_ms", "update_ms", "plan_within_ms")
"""Keys of a budget that only a board with a planner may have."""


def build_rack_timing(
    config: RackConfig, layout: Layout, measured: Mapping[str, Budget] | None = None
) -> RackTiming:
    """Build the timing model's record of a rack.

    Args:
        config: The config of the rack.
        layout: Its layout.
        measured: Budgets, keyed by board. None to use the budgets in the config.
    """
    measured = read_budgets(config) if measured is None else measured
    goal_ms = config.timing.response_ms
    clock_cost_ns = round(config.timing.clock_ms * NS_PER_MS)
    schedule = None if config.schedule is None else compute_frames(config.schedule, config.clock_ns)
    return RackTiming(
        is_lockstep=config.is_lockstep,
        speed=config.clock.speed,
        clock_ns=config.clock_ns,
        clock=TimedTask(
            CLOCK,
            CLOCK,
            "clock",
            config.clock.core,
            config.clock.priority,
            config.tick_ns,
            (Part(Unit.PROCESS, clock_cost_ns),) if clock_cost_ns else (),
            scheduler=find_clock_scheduler(config),
            is_critical=True,
        ),
        boards={
            name: _build_board_timing(config, layout, name, measured.get(name))
            for name in config.board
        },
        context_switch_ns=round(config.timing.context_switch_ms * NS_PER_MS),
        small_share=config.timing.small_share,
        response_goal_ns=None if goal_ms is None else goal_ms * NS_PER_MS,
        inboxes=build_inboxes(layout),
        schedule=schedule,
    )


def compute_frames(table: ScheduleConfig, clock_ns: int) -> CyclicSchedule:
    """Return the minor and major frame of a static schedule, rounded to ticks."""
    return CyclicSchedule(*(round(ms * 1e6 / clock_ns) for ms in (table.minor_ms, table.major_ms)))


def build_inboxes(layout: Layout) -> dict[str, InboxTiming]:
    """Return the inboxes of boards that messages interrupt, keyed by the task that serves them."""
    timings = {}
    for slot in dict.fromkeys(task.slot for task in layout.tasks):
        if boxes := layout.list_interrupting_mailboxes(slot):
            name = layout.find_interrupt_task(slot)
            task = layout.find_task(name)
            timings[name] = InboxTiming(
                name,
                tuple(box.name for box in boxes),
                list_sources(layout, slot),
                get_interrupt_spec(boxes[0]).depth,
                period_ns=task.slice * layout.clock_ns,
                first_ns=task.phase * layout.clock_ns,
            )
    return timings


def subtract_interrupts(timing: RackTiming, measured: Mapping[str, Budget]) -> dict[str, Budget]:
    """Subtract the time that interrupts took from budgets measured in a run.

    In lockstep interrupts take no time, so the budgets are unchanged.
    """
    if timing.is_lockstep:
        return dict(measured)
    return {
        name: replace(
            budget,
            process_ns=max(0, budget.process_ns - timing.compute_interrupted_ns(name)),
            plan_ns=max(0, budget.plan_ns - timing.compute_interrupted_ns(f"{name}.planner")),
        )
        for name, budget in measured.items()
    }


def _build_board_timing(
    config: RackConfig, layout: Layout, name: str, budget: Budget | None
) -> BoardTiming:
    """Return the timing model's record of one board."""
    board = config.board[name]
    within_ms = None if board.budget is None else board.budget.plan_within_ms
    within_ns = None if within_ms is None else round(within_ms * NS_PER_MS)
    return BoardTiming(
        name=name,
        above=tuple(upper for upper, lower in config.list_links() if lower == name),
        coupling=board.coupling,
        every=(task := layout.find_task(name)).every,
        due=layout.compute_due_ticks(task),
        within_cycles=board.within_cycles,
        core=board.core,
        priority=board.priority,
        planner_core=board.core if board.planner_core is None else board.planner_core,
        planner_priority=board.planner_priority,
        has_planner=board.planner is not None,
        is_critical=is_critical(config, layout, name),
        budget=budget,
        plan_within_ns=within_ns,
        queues=tuple(box.name for box in layout.mailboxes if box.capacity and name in box.readers),
        phase=board.phase,
        scheduler=find_scheduler(config, name),
        is_urgent=board.critical,
        standbys=tuple(
            StandbyPlace(place.name, place.core, place.priority)
            for place in config.list_standbys()
            if place.board == name
        ),
        reads=_find_read_ticks(layout, name),
    )


def _find_read_ticks(layout: Layout, board: str) -> dict[str, TickGrid]:
    """Return a dictionary from writer to the ticks at which an executor reads its messages.

    It contains only writers that the executor's `exchange` table concerns. If several ports read
    messages of one writer, the least frequently read port determines the ticks.
    """
    grids: dict[str, TickGrid] = {}
    for box in layout.mailboxes:
        for exchange in box.exchanges:
            if exchange.task == board:
                grids[box.writer] = max(grids.get(box.writer, exchange.grid), exchange.grid)
    return grids


def compute_first_tick(entry: CommandConfig | FaultConfig, layout: Layout) -> int:
    """Return the first tick at which a command or fault is due. -1 if it is due at once."""
    if entry.at is not None:
        return layout.to_ticks(entry.at)
    return -1 if entry.tick is None else entry.tick


def is_critical(config: RackConfig, layout: Layout, board: str) -> bool:
    """Return True if a board's plan update is the paper's critical section.

    That is the case for a tightly coupled planner under protocol lock.

    Args:
        config: The config of the rack.
        layout: Its layout.
        board: Name of the board.
    """
    return (
        config.board[board].coupling == "tight"
        and layout.find_mailbox(f"{board}.plan").protocol == "lock"
    )


def read_budgets(config: RackConfig) -> dict[str, Budget]:
    """Return a dictionary from board to its budget in the config, for boards that have one."""
    return {
        name: Budget(
            **{part: round(getattr(board.budget, key) * NS_PER_MS) for part, key in KEYS.items()}
        )
        for name, board in config.board.items()
        if board.budget is not None
    }


def replace_budgets(config: RackConfig, measured: Mapping[str, Budget]) -> RackConfig:
    """Return a copy of a config with its budgets replaced by measured ones, keyed by board.

    Boards without a measured budget have none in the copy. Limits are kept.
    """
    boards = {}
    for name, board in config.board.items():
        budget = None
        if name in measured:
            times = {KEYS[part]: ns / NS_PER_MS for part, ns in asdict(measured[name]).items()}
            if board.planner is None:
                times = {key: ms for key, ms in times.items() if key not in PLANNER_BUDGET}
            budget = (board.budget or BudgetConfig()).model_copy(update=times)
        boards[name] = board.model_copy(update={"budget": budget})
    return config.model_copy(update={"board": boards})
