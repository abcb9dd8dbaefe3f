"""Changes of a config that make a board of it fit: of every kind the smallest, each tried on the whole rack.

The paper names two of them: another processor for the planner, a longer response time (sections 3.2 and 3.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from rack.backplane.layout import Protocol
from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, LONGEST_EVERY
from rack.boards.config.timing import is_critical, tick_ns
from rack.tools.timing.change import Change
from rack.tools.timing.level_timing import LevelTiming
from rack.tools.timing.trial import Settings, Trial

MOST_CYCLES = 10_000
"""What `within_cycles` may be."""
LONGEST = 16
"""A cycle so many times as long would be another level's, a plan so many times as old of another world: not tried."""
MOST_CYCLES_TRIED = 400
"""Cycles of one board that are looked at, at most: of long ones not every tick's."""
MOST_OTHERS = 3
"""Boards on the same core that changes are looked for of, those that compute most."""
HIGHEST = 99
"""SCHED_FIFO's highest priority."""

T = TypeVar("T")
R = TypeVar("R")


def changes_for(trial: Trial, board: str) -> list[Change]:
    """Return the changes that make a board fit, by what they cost (`Change.cost`): one of each kind, its smallest.

    Another priority, or a core that is in use, costs nothing; then come a slot and a new core; then older plans and
    longer cycles, of the board or of one that shares a core with it, by their factor. Where none does by itself, the
    planner elsewhere and a longer cycle together may.
    """
    kinds = (_other_priority, _board_elsewhere, _planner_elsewhere, _more_cycles, _longer_cycle)
    found = [change for kind in kinds if (change := kind(trial, board)) is not None]
    found += _changes_of_others(trial, board)
    found = found or [change for change in [_elsewhere_and_longer(trial, board)] if change is not None]
    return sorted(found, key=lambda change: change.cost)


def _other_priority(trial: Trial, board: str) -> Change | None:
    """Put the board's executor, or its planner, above another task on its core: the least that helps."""
    table, most = trial.config.board[board], trial.config.clock.priority or HIGHEST + 1
    for key, task in (("priority", board), ("planner_priority", f"{board}.planner")):
        core, own = trial.cores.get(task), getattr(table, key)
        above = {other.priority + 1 for other in trial.tasks if other.core == core and other.name != task}
        tried = ({key: priority} for priority in sorted(above) if own < priority < most)
        if (change := next((found for one in tried if (found := _first(trial, board, [one]))), None)) is not None:
            return change
    return None


def _changes_of_others(trial: Trial, board: str) -> list[Change]:
    """Return the cheapest change of each board that shares a core with this one: another core, or a longer cycle."""
    cores, loads = trial.cores_of(board), {task.board: 0.0 for task in trial.tasks}
    for task in trial.tasks:
        loads[task.board] += task.cost_ns / task.period_ns if task.core in cores else 0.0
    others = [name for name in trial.config.board if loads.get(name) and name != board]
    found = []
    for other in sorted(others, key=lambda name: -loads[name])[:MOST_OTHERS]:
        changes = (_task_elsewhere(trial, other, board), _longer_cycle(trial, other, cures=board))
        found += sorted((change for change in changes if change is not None), key=lambda change: change.cost)[:1]
    return found


def _more_cycles(trial: Trial, board: str) -> Change | None:
    level = trial.level(board)
    if level.within_cycles is None:
        return None
    return _first(trial, board, [{"within_cycles": d} for d in _cycles(level, level.within_cycles + 1)])


def _planner_elsewhere(trial: Trial, board: str) -> Change | None:
    """Couple a planner loosely, or take a loose one to another core; where no core is enough, with more cycles."""
    level, places = trial.level(board), list(_places(trial, board))
    for place in places:
        if (change := _first(trial, board, [place])) is not None:
            return change
    older = _cycles(level, (level.within_cycles or 0) + 1)
    found = [_first(trial, board, [{**place, "within_cycles": d} for d in older]) for place in places]
    return min((change for change in found if change is not None), key=lambda change: change.cost, default=None)


def _board_elsewhere(trial: Trial, board: str) -> Change | None:
    cores = _other_cores(trial, trial.config.board[board].core)
    return next((change for core in cores if (change := _first(trial, board, [{"core": core}])) is not None), None)


def _task_elsewhere(trial: Trial, board: str, cures: str) -> Change | None:
    """Take a board, or its loose planner alone, to another core in use, so that another board fits."""
    table = trial.config.board[board]
    keys = ["core"] if table.planner_core is None else ["planner_core", "core"]
    tried = [{key: core} for key in keys for core in _other_cores(trial, getattr(table, key))]
    return next((change for one in tried if (change := _first(trial, board, [one], cures)) is not None), None)


def _longer_cycle(trial: Trial, board: str, place: Settings | None = None, cures: str | None = None) -> Change | None:
    """Lengthen a cycle; where the config says how soon it wants a plan, a plan may then have fewer cycles."""
    level, every = trial.level(board), trial.layout.task(board).every
    if place is not None:
        level = replace(level, coupling="loose")
    step = max(1, every * (LONGEST - 1) // MOST_CYCLES_TRIED)
    longest = min(LONGEST * every, LONGEST_EVERY)
    tried = (_lengthened(trial, level, longer) for longer in range(every + step, longest + 1, step))
    # Sorted out first: behind a sound one another may be no grid with the other levels, or leave plans too few cycles.
    sound = [{**(place or {}), **settings} for changed, settings in tried if trial.is_sound(changed)]
    return _first(trial, board, sound, cures)


def _elsewhere_and_longer(trial: Trial, board: str) -> Change | None:
    places = _places(trial, board)
    return next((change for place in places if (change := _longer_cycle(trial, board, place)) is not None), None)


def _places(trial: Trial, board: str) -> Iterator[Settings]:
    """Yield where a planner could be loosely coupled instead, as settings; nothing where there is no such planner."""
    table = trial.config.board[board]
    slot = _free_slot(trial) if table.planner_slot is None else table.planner_slot
    if trial.level(board).within_cycles is not None and slot is not None:
        core = table.core if table.planner_core is None else table.planner_core
        for other in _other_cores(trial, core):
            yield {"coupling": "loose", "planner_slot": slot, "planner_core": other}


def _cycles(level: LevelTiming, least: int) -> range:
    """Return the cycles that a plan of a level may have, `least` and more."""
    most = min((level.within_cycles or 1) * LONGEST, MOST_CYCLES)
    return range(
        least, most + 1 if level.plan_within_ns is None else min(level.plan_within_ns // level.cycle_ns, most) + 1
    )


def _lengthened(trial: Trial, level: LevelTiming, every: int) -> tuple[LevelTiming, Settings]:
    """Return a level with another cycle, and the settings that make it."""
    cycle_ns, cycles, longest_ns = every * tick_ns(trial.config), level.within_cycles, level.longest_cycle_ns
    settings: dict[str, Any] = {"every": every, "rate_hz": None}
    if cycles is not None and level.plan_within_ns is not None:
        settings["within_cycles"] = cycles = max(min(cycles, level.plan_within_ns // cycle_ns), 1)
    if trial.config.timing.response_ms is None:
        longest_ns = max(longest_ns, cycle_ns)
    return replace(level, cycle_ns=cycle_ns, longest_cycle_ns=longest_ns, within_cycles=cycles), settings


def _other_cores(trial: Trial, core: int) -> Iterator[int]:
    """Yield the cores where something could go instead: used ones, the least loaded first, then one that is not used.

    A core with a board that has no budget is left out: nobody could tell whether it has room.
    """
    config, loads = trial.config, trial.loads
    used = set(trial.cores.values())
    unknown = {core for name in config.board.keys() - trial.budgets.keys() for core in trial.cores_of(name)}
    yield from sorted(used - unknown - {core}, key=lambda other: (loads.get(other, 0.0), other))
    yield next(free for free in range(len(used) + 1) if free not in used)


def _free_slot(trial: Trial) -> int | None:
    taken = {slot for table in trial.config.board.values() for slot in (table.slot, table.planner_slot)}
    return next((slot for slot in range(CLOCK_SLOT + 1, LAST_SLOT + 1) if slot not in taken), None)


def _first(trial: Trial, board: str, tried: Sequence[Settings], cures: str | None = None) -> Change | None:
    """Return the change of a board with the first of the settings that cures it, or another; None: none does."""

    def attempt(settings: Settings) -> Change | None:
        mailboxes: dict[str, Protocol] = {}
        if settings.get("coupling") == "loose" and is_critical(trial.config, trial.layout, board):
            # Between two processors the paper wants time slices or double buffers (section 3.3).
            mailboxes = {f"{board}.plan": "time-slice"}
        after = trial.changed(board, settings, mailboxes)
        return Change(board, trial, after) if after is not None and after.cures(cures or board, trial) else None

    return first_that(tried, attempt)


def first_that(tried: Sequence[T], attempt: Callable[[T], R | None]) -> R | None:
    """Return what `attempt` makes of the first that it makes anything of, in few attempts; None: of none.

    They stand in such an order that behind one that works all others work too.
    """
    # Steps that double lead beyond the first that works, halves back to it.
    low, high, found = -1, 0, None
    while high < len(tried) and (found := attempt(tried[high])) is None:
        low, high = high, min(2 * high + 1, max(len(tried) - 1, high + 1))
    while found is not None and high - low > 1:
        middle = (low + high) // 2
        earlier = attempt(tried[middle])
        low, high, found = (middle, high, found) if earlier is None else (low, middle, earlier)
    return found
