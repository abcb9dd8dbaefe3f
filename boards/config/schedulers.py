"""Schedulers of a config: the scheduler of each board, and the processor time that it reserves."""

from __future__ import annotations

from typing import get_args

from rack.backplane.address_map import CLOCK
from rack.backplane.process import Reservation
from rack.backplane.words import SCHEDULERS, Scheduler
from rack.boards.config.files import LAN_ADAPTER
from rack.boards.config.schema import RackConfig, SchedulerName, TaskEntry
from rack.boards.errors import Mistake, Mistakes
from rack.boards.wiring import Scheduling

NS_PER_MS = 1e6
RESERVED_BUDGETS = 2
"""Factor between a board's budget and the processor time that it reserves per cycle.

A budget is a 99th percentile, and the kernel suspends a task that exceeds its reservation until its
next cycle.
"""


def names_scheduler(config: RackConfig) -> bool:
    """Return True if a config names a scheduler, so that an operator may change it."""
    return bool(config.clock.scheduler) or any(b.scheduler for b in config.board.values())


def list_valid_schedulers(config: RackConfig) -> tuple[str, ...]:
    """Return the names of the schedulers that boards may have in the clock mode of a config."""
    # Linux has no scheduler by urgency.
    return get_args(SchedulerName)[: 3 if config.is_lockstep else 2]


def find_scheduler(config: RackConfig, board: str) -> Scheduler:
    """Return the scheduler of a board's executor at the launch."""
    word = config.board[board].scheduler or config.clock.scheduler or "fixed-priority"
    return SCHEDULERS[word]


def find_clock_scheduler(config: RackConfig) -> Scheduler:
    """Return the scheduler of the clock, which competes like the boards on its core."""
    core = config.clock.core
    found = [find_scheduler(config, n) for n, board in config.board.items() if board.core == core]
    return max([Scheduler.FIXED_PRIORITY, *found])


def build_scheduling(
    config: RackConfig, task: TaskEntry, every: int, *, is_locked: bool
) -> Scheduling | None:
    """Return how a task is scheduled.

    Args:
        config: The config of the rack.
        task: The task.
        every: Period of the task in ticks.
        is_locked: Whether the task is a planner whose executor must wait for its plan updates.

    Returns:
        None if the config names no scheduler, and for a planner that is not on a simulated core.
    """
    table = config.board[task.board]
    load = config.simulated_load
    is_planner = task.role == "planner"
    if not names_scheduler(config) or (is_planner and not load):
        return None
    clocks = None
    if task.core == config.clock.core:
        clocks = _compute_reservation(config, config.timing.clock_ms, 1)
    locked_ms = table.budget.update_ms if is_locked and table.budget else 0.0
    return Scheduling(
        task.core,
        task.priority,
        Scheduler.FIXED_PRIORITY if is_planner else find_scheduler(config, task.board),
        is_critical=table.critical,
        cost_ns=round(load * (table.planning_ms if is_planner else table.busy_ms) * NS_PER_MS),
        switch_ns=round(2 * config.timing.context_switch_ms * NS_PER_MS),
        locked_ns=round(load * locked_ms * NS_PER_MS),
        ceiling=table.priority if is_locked else 0,
        reservation=None if is_planner else _compute_reservation(config, table.busy_ms, every),
        clocks=clocks,
    )


def build_clock_scheduling(config: RackConfig) -> dict[str, Scheduling]:
    """Return how the clock competes for its simulated core. Empty if it takes no time on one."""
    cost_ns = round(config.simulated_load * config.timing.clock_ms * NS_PER_MS)
    if not cost_ns:
        return {}
    clock = config.clock
    scheduling = Scheduling(
        clock.core,
        clock.priority,
        find_clock_scheduler(config),
        is_critical=True,
        cost_ns=cost_ns,
        switch_ns=round(2 * config.timing.context_switch_ms * NS_PER_MS),
        locked_ns=0,
        ceiling=0,
        reservation=None,
        clocks=None,
    )
    return {CLOCK: scheduling}


def compute_clock_reservation(config: RackConfig) -> Reservation | None:
    """Return the processor time that the clock reserves at the launch.

    None if no board on its core does. Otherwise the clock would run below that board.
    """
    if find_clock_scheduler(config) is not Scheduler.EARLIEST_DEADLINE_FIRST:
        return None
    return _compute_reservation(config, config.timing.clock_ms, 1)


def _compute_reservation(config: RackConfig, busy_ms: float, every: int) -> Reservation | None:
    """Return the processor time to reserve per period. None without a budget, or in lockstep.

    Args:
        config: The config of the rack.
        busy_ms: Budgeted processor time of one cycle in ms.
        every: Period of the task in ticks.
    """
    if config.is_lockstep or not busy_ms:
        return None
    period_ns = every * config.tick_ns
    return Reservation(min(round(RESERVED_BUDGETS * busy_ms * NS_PER_MS), period_ns), period_ns)


def list_reservation_mistakes(config: RackConfig, name: str, key: str) -> Mistakes:
    """Yield why a board cannot reserve processor time, as earliest deadline first requires.

    Args:
        config: The config of the rack.
        name: The board.
        key: Key that chooses the scheduler.
    """
    board = config.board[name]
    place = f"board.{name}"
    if not board.busy_ms:
        yield Mistake(f"{place}.budget", None, "missing; the board reserves twice its budget")
    if (board.wake or config.clock.wake) == "poll":
        yield Mistake(f"{place}.wake", "poll", "busy-waiting uses up the reserved time")
    if board.coupling == "tight":
        why = "a planner with the executor's priority would run below all reservations"
        yield Mistake(f"{place}.coupling", "tight", why)
    if board.executor == LAN_ADAPTER:
        why = "the network adapter's threads need its priority; use fixed-priority"
        yield Mistake(key, Scheduler.EARLIEST_DEADLINE_FIRST.word, why)
