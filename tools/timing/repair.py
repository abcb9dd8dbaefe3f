"""Changes that make a rack fit its cycles: of every kind the smallest, each tried on the whole
rack.

The paper names two kinds: another processor for the planner, and a longer response time (sections
3.2 and 3.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rack.boards.config.schema import CLOCK_SLOT, LAST_SLOT, LONGEST_EVERY
from rack.boards.timing.level import LevelTiming
from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Document
from rack.tools.timing.judged_config import Change, JudgedConfig, Settings

MAX_CYCLES = 10_000
"""Largest permitted `within_cycles`."""
MAX_FACTOR = 16
"""Cycles and plan ages are tried up to this many times as long: beyond, it would be another
level."""
MAX_CYCLES_TRIED = 400
"""Longer cycles tried for one board; for a long cycle not every tick."""
MAX_OTHERS = 3
"""Other boards on the same core that changes are tried on, those with the highest load."""
HIGHEST = 99
"""SCHED_FIFO's highest priority."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Repair:
    """The changes that make a rack fit. Each step holds the changes for one board, cheapest first.

    The next step builds on the first change of the step before it.
    """

    steps: tuple[tuple[Change, ...], ...]
    end: JudgedConfig

    @property
    def left(self) -> tuple[EquationVerdict, ...]:
        """The failures that remain after the last step."""
        return self.end.failing

    def lines(self) -> list[str]:
        """Return every step as text, a line per change, and the failures that remain."""
        found: list[str] = []
        for changes in self.steps:
            start = "then, with the first of these" if found else "to make it fit"
            if len(changes) > 1:
                start += ", one of these, cheapest first"
            found.append(f"{start}:")
            found += [f"  {change.text}" for change in changes]
        if self.left:
            failing = ", ".join(
                dict.fromkeys(f"{verdict.equation} of {verdict.subject}" for verdict in self.left)
            )
            tried = (
                f"other priorities and cores, cycles and plans up to {MAX_FACTOR} times as long,"
                " also of others"
            )
            found.append(f"no change helps with {failing}; tried: {tried}")
        return found

    def document(self) -> Document:
        """Return it as plain data."""
        return {
            "steps": [[change.document() for change in changes] for changes in self.steps],
            "fits": not self.left,
        }


def repair(rack: JudgedConfig) -> Repair:
    """Return the changes that make a rack fit: for one board, then, with the cheapest of them, for
    the next.
    """
    steps: list[tuple[Change, ...]] = []
    while rack.failing:
        found = next(
            (changes for board in _failing_boards(rack) if (changes := changes_for(rack, board))),
            None,
        )
        if found is None:
            break
        steps.append(tuple(found))
        rack = found[0].after
    return Repair(tuple(steps), rack)


def _failing_boards(rack: JudgedConfig) -> list[str]:
    """Return the boards with failures, those first that others wait for."""
    failing = [name for name in rack.timing.levels if rack.failing_of(name)]
    own = {verdict.subject.partition(".")[0] for verdict in rack.failing}
    # An overloaded core concerns all its boards; those with failures of their own come first.
    return sorted(failing, key=lambda name: (name not in own, -rack.config.board[name].priority))


def changes_for(rack: JudgedConfig, board: str) -> list[Change]:
    """Return the changes that make a board fit, sorted by `Change.cost`: the smallest of each kind.

    Another priority, or a core already in use, costs nothing. Next come a slot and a new core, then
    older plans and longer cycles, of the board or of one that shares its core, by their factor. If
    none of these helps alone, moving the planner and lengthening the cycle together may.
    """
    found = [*_own_changes(rack, board), *_changes_of_others(rack, board)]
    if not found:
        both = (
            _first(rack, board, _longer_cycles(rack, board, place))
            for place in _places(rack, board)
        )
        found = [change for change in both if change is not None][:1]
    return sorted(found, key=lambda change: change.cost)


def _own_changes(rack: JudgedConfig, board: str) -> Iterator[Change]:
    """Yield the smallest change of each kind of a board that helps."""
    older = [{"within_cycles": d} for d in _cycles(rack.timing.level(board))]
    cores = [{"core": core} for core in _other_cores(rack, rack.config.board[board].core)]
    places = list(_places(rack, board))
    planner = _any(rack, board, places)
    if planner is None:
        # Another place is not enough: with more cycles for a plan it may be.
        moved = (_first(rack, board, [{**d, **place} for d in older]) for place in places)
        planner = _cheapest(moved)
    kinds = (
        _any(rack, board, _priorities(rack, board)),
        _any(rack, board, cores),
        planner,
        _first(rack, board, older),
        _first(rack, board, _longer_cycles(rack, board)),
    )
    yield from (change for change in kinds if change is not None)


def _priorities(rack: JudgedConfig, board: str) -> Iterator[Settings]:
    """Yield the priorities of a board's executor, or its planner, above other tasks on its core,
    the smallest rise first.
    """
    table = rack.config.board[board]
    limit = rack.config.clock.priority or HIGHEST + 1
    for key, task in (("priority", board), ("planner_priority", f"{board}.planner")):
        core = rack.timing.cores.get(task)
        own = getattr(table, key)
        above = {
            other.priority + 1
            for other in rack.timing.tasks
            if other.core == core and other.name != task
        }
        yield from ({key: priority} for priority in sorted(above) if own < priority < limit)


def _changes_of_others(rack: JudgedConfig, board: str) -> Iterator[Change]:
    """Yield the cheapest change of each board that shares a core with this one: another core, of
    the board or of its loose planner alone, or a longer cycle.
    """
    timing = rack.timing
    cores = timing.cores_of(board)
    loads = {task.board: 0.0 for task in timing.tasks}
    for task in timing.tasks:
        loads[task.board] += task.cost_ns / task.period_ns if task.core in cores else 0.0
    others = [name for name in timing.boards if loads.get(name) and name != board]
    for other in sorted(others, key=lambda name: -loads[name])[:MAX_OTHERS]:
        table = rack.config.board[other]
        keys = ["core"] if table.planner_core is None else ["planner_core", "core"]
        moves = ({key: core} for key in keys for core in _other_cores(rack, getattr(table, key)))
        change = _cheapest(
            (
                _any(rack, other, moves, board),
                _first(rack, other, _longer_cycles(rack, other), board),
            )
        )
        if change is not None:
            yield change


def _cheapest(changes: Iterable[Change | None]) -> Change | None:
    found = (change for change in changes if change is not None)
    return min(found, key=lambda change: change.cost, default=None)


def _longer_cycles(rack: JudgedConfig, board: str, place: Settings | None = None) -> list[Settings]:
    """Return longer cycles of a board, its planner in another place if one is given; with a limit
    on the age of plans, a plan may then get fewer cycles.
    """
    every = rack.timing.boards[board].every
    timing = rack.timing if place is None else rack.timing.changed(board, coupling="loose")
    level = timing.level(board)
    step = max(1, every * (MAX_FACTOR - 1) // MAX_CYCLES_TRIED)
    longest = min(MAX_FACTOR * every, LONGEST_EVERY)
    found: list[Settings] = []
    for longer in range(every + step, longest + 1, step):
        cycles = timing.boards[board].within_cycles
        changed: Settings = {}
        if level.within_cycles is not None and level.plan_within_ns is not None:
            cycles = max(min(cycles, level.plan_within_ns // (longer * timing.tick_ns)), 1)
            changed = {"within_cycles": cycles}
        # Filtered first, as soundness is not monotonic: a longer cycle may fit the grid of the
        # other levels less well, or leave plans too few cycles.
        if rack.is_sound(timing.changed(board, every=longer, within_cycles=cycles), board):
            found.append({**changed, **(place or {}), "every": longer, "rate_hz": None})
    return found


def _places(rack: JudgedConfig, board: str) -> Iterator[Settings]:
    """Yield settings for each place where the board's planner could be loosely coupled; none
    without a planner.
    """
    slot = rack.config.board[board].planner_slot
    if slot is None:
        tables = rack.config.board.values()
        taken = {slot for table in tables for slot in (table.slot, table.planner_slot)}
        free = (slot for slot in range(CLOCK_SLOT + 1, LAST_SLOT + 1) if slot not in taken)
        slot = next(free, None)
    if rack.timing.level(board).within_cycles is not None and slot is not None:
        for other in _other_cores(rack, rack.timing.boards[board].planner_core):
            yield {"coupling": "loose", "planner_slot": slot, "planner_core": other}


def _cycles(level: LevelTiming) -> range:
    """Return the longer times, in cycles, that a plan of a level may take; none without a
    planner.
    """
    if level.within_cycles is None:
        return range(0)
    longest = min(level.within_cycles * MAX_FACTOR, MAX_CYCLES)
    if level.plan_within_ns is not None:
        longest = min(level.plan_within_ns // level.cycle_ns, longest)
    return range(level.within_cycles + 1, longest + 1)


def _other_cores(rack: JudgedConfig, core: int) -> Iterator[int]:
    """Yield the cores to which a task could move: used ones, the least loaded first, then an unused
    one.

    A core of a board without a budget is left out: its free time is unknown.
    """
    timing = rack.timing
    used = set(timing.cores.values())
    unknown = {
        core
        for name in timing.boards.keys() - timing.levels.keys()
        for core in timing.cores_of(name)
    }
    yield from sorted(
        used - unknown - {core}, key=lambda other: (timing.loads.get(other, 0.0), other)
    )
    yield next(free for free in range(len(used) + 1) if free not in used)


def _attempt(
    rack: JudgedConfig, board: str, settings: Settings, cures: str | None
) -> Change | None:
    """Return the change of a board if it cures the board, or the board `cures`."""
    change = rack.change(board, settings)
    return change if change is not None and change.after.cures(cures or board, rack) else None


def _any(
    rack: JudgedConfig, board: str, tried: Iterable[Settings], cures: str | None = None
) -> Change | None:
    """Return the first change that works, trying one after another."""
    return next(
        (change for one in tried if (change := _attempt(rack, board, one, cures)) is not None), None
    )


def _first(
    rack: JudgedConfig, board: str, tried: Sequence[Settings], cures: str | None = None
) -> Change | None:
    """Return the first change that works, in few attempts; see `first_that`."""
    return first_that(tried, lambda settings: _attempt(rack, board, settings, cures))


def first_that(tried: Sequence[T], attempt: Callable[[T], R | None]) -> R | None:
    """Return the result of `attempt` for the first item that has one, in few attempts; None if none
    has.

    The items must be ordered: all items after one that works also work.
    """
    # Doubling steps find an item that works, halving steps the first one.
    low = -1
    high = 0
    found = None
    while high < len(tried) and (found := attempt(tried[high])) is None:
        low = high
        high = min(2 * high + 1, max(len(tried) - 1, high + 1))
    while found is not None and high - low > 1:
        middle = (low + high) // 2
        earlier = attempt(tried[middle])
        low, high, found = (middle, high, found) if earlier is None else (low, middle, earlier)
    return found
