"""Changes of a config that make a board of it fit: of every kind the smallest, each tried on the whole rack.

The paper names two of them: another processor for the planner, a longer response time (sections 3.2 and 3.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from backplane.layout import Protocol
from boards.config.schema import CLOCK_SLOT, LAST_SLOT
from boards.config.timing import is_critical, tick_ns
from tools.timing.change import Change
from tools.timing.level_timing import LevelTiming
from tools.timing.trial import Settings, Trial

MOST_CYCLES = 10_000
"""What `within_cycles` may be."""
LONGEST = 16
"""A cycle so many times as long would be another level's: no longer one is tried."""

T = TypeVar("T")
R = TypeVar("R")


def changes_for(trial: Trial, board: str) -> list[Change]:
    """Return the changes of a board that make it fit, by what they cost: one of each kind, its smallest.

    More cycles for a plan cost nothing but its age; then a slot and a core for the planner; a core for the whole
    board; a longer cycle slows down the level, and the system's response. Where none does by itself, the planner
    elsewhere and a longer cycle together may.
    """
    kinds = (_more_cycles, _planner_elsewhere, _board_elsewhere, _longer_cycle)
    found = [change for kind in kinds if (change := kind(trial, board)) is not None]
    return found or [change for change in [_elsewhere_and_longer(trial, board)] if change is not None]


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
    # A new core costs less than much older plans.
    older = _cycles(level, (level.within_cycles or 0) + 1)
    found = [_first(trial, board, [{**place, "within_cycles": d} for d in older]) for place in places]
    changes = [change for change in found if change is not None]
    return min(changes, key=lambda change: change.after.level(board).slice_ns or 0, default=None)


def _board_elsewhere(trial: Trial, board: str) -> Change | None:
    cores = _other_cores(trial, trial.config.board[board].core)
    return next((change for core in cores if (change := _first(trial, board, [{"core": core}])) is not None), None)


def _longer_cycle(trial: Trial, board: str, place: Settings | None = None) -> Change | None:
    """Lengthen a cycle; where the config says how soon it wants a plan, a plan may then have fewer cycles."""
    level, every = trial.level(board), trial.layout.task(board).every
    if place is not None:
        level = replace(level, coupling="loose")
    tried = (_lengthened(level, longer, tick_ns(trial.config)) for longer in range(every + 1, LONGEST * every + 1))
    # Sorted out first: behind a sound one another may be no grid with the other levels, or leave plans too few cycles.
    sound = [{**(place or {}), **settings} for changed, settings in tried if trial.is_sound(changed)]
    return _first(trial, board, sound)


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
    most = MOST_CYCLES if level.plan_within_ns is None else min(level.plan_within_ns // level.cycle_ns, MOST_CYCLES)
    return range(least, most + 1)


def _lengthened(level: LevelTiming, every: int, clock_ns: int) -> tuple[LevelTiming, Settings]:
    """Return a level with another cycle, and the settings that make it."""
    cycle_ns, cycles = every * clock_ns, level.within_cycles
    settings: dict[str, Any] = {"every": every, "rate_hz": None}
    if cycles is not None and level.plan_within_ns is not None:
        settings["within_cycles"] = cycles = max(min(cycles, level.plan_within_ns // cycle_ns), 1)
    longest_ns = max(level.longest_cycle_ns, cycle_ns)
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


def _first(trial: Trial, board: str, tried: Sequence[Settings]) -> Change | None:
    """Return the change with the first of the settings that cures the board; None: none does."""

    def attempt(settings: Settings) -> Change | None:
        mailboxes: dict[str, Protocol] = {}
        if settings.get("coupling") == "loose" and is_critical(trial.config, trial.layout, board):
            # Between two processors the paper wants time slices or double buffers (section 3.3).
            mailboxes = {f"{board}.plan": "time-slice"}
        after = trial.changed(board, settings, mailboxes)
        return Change(board, trial, after) if after is not None and after.cures(board, trial) else None

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
