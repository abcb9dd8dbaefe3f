"""Changes that make a rack fit its cycles: the smallest of each kind, tested on the whole rack.

The paper names two kinds: another processor for the planner, and a longer response time (sections
3.2 and 3.3).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rack.boards.config.schema import LONGEST_EVERY
from rack.boards.timing.level import LevelTiming
from rack.tools.console.answer import Document
from rack.tools.timing.judged_config import Change, JudgedConfig, Settings

MAX_CYCLES = 10_000
"""Largest permitted `within_cycles`."""
MAX_FACTOR = 16
"""Largest factor by which cycles and plan ages are lengthened.

A longer cycle would make it another level.
"""
MAX_CYCLES_TRIED = 400
"""Number of longer cycles that are tried for one board. A long cycle skips some ticks."""
MAX_PRIORITY = 99
"""Highest SCHED_FIFO priority."""


@dataclass(frozen=True)
class Fix:
    """Changes that make a rack fit, each of which builds on the previous one."""

    changes: tuple[Change, ...]

    @property
    def settings(self) -> list[str]:
        """The changes as `key=value`, as `--set` takes them."""
        config = self.changes[0].before.config
        values: dict[str, Any] = {}
        for change in self.changes:
            for key, value in change.settings.items():
                # A config must not give both.
                if key == "every" and config.board[change.board].rate_hz is not None:
                    key, value = "rate_hz", 1e9 / (value * config.clock_ns)
                if value is not None:
                    values[f"board.{change.board}.{key}"] = value
            for mailbox, protocol in change.protocols.items():
                values[f'protocol.mailbox."{mailbox}"'] = protocol
        return [f"{key}={value}" for key, value in values.items()]


@dataclass(frozen=True)
class Repair:
    """Changes that make a rack fit.

    Attributes:
        steps: Each step contains alternative changes of one board, cheapest first. It builds on the
            first change of the previous step.
        end: The rack after the last step.
    """

    steps: tuple[tuple[Change, ...], ...]
    end: JudgedConfig

    def list_fixes(self) -> Iterator[Fix]:
        """Yield sequences of changes after each of which the rack fits, shortest first."""
        firsts = tuple(changes[0] for changes in self.steps)
        for at, changes in enumerate(self.steps):
            yield from (
                Fix((*firsts[:at], change)) for change in changes if not change.after.failures
            )

    def to_document(self) -> Document:
        """Convert the repair to plain data."""
        return {
            "steps": [[change.to_document() for change in changes] for changes in self.steps],
            "fits": not self.end.failures,
        }


def find_repair(rack: JudgedConfig) -> Repair:
    """Find the changes that make a rack fit.

    One board is handled at a time. Its cheapest change is applied before the next board is handled.
    """
    steps: list[tuple[Change, ...]] = []
    while rack.failures:
        best = next(
            (
                changes
                for board in _list_failing_boards(rack)
                if (changes := find_changes(rack, board))
            ),
            None,
        )
        if best is None:
            break
        steps.append(tuple(best))
        rack = best[0].after
    return Repair(tuple(steps), rack)


def _list_failing_boards(rack: JudgedConfig) -> list[str]:
    """Return the boards with failures, beginning with those whose own tasks fail.

    Within each of these two groups, boards are sorted by descending priority.
    """
    failing = [name for name in rack.timing.levels if rack.find_failures(name)]
    own = {verdict.subject.partition(".")[0] for verdict in rack.failures}
    # An overloaded core affects all its boards.
    return sorted(failing, key=lambda name: (name not in own, -rack.config.board[name].priority))


def find_changes(rack: JudgedConfig, board: str) -> list[Change]:
    """Return the smallest change of each kind that makes a board fit, sorted by `Change.cost`.

    Other priorities and moves to cores already in use cost least. New slots and cores cost more.
    Longer cycles and older plans cost most, depending on their factor. If no single change is
    enough, the planner is coupled loosely on another core, which leaves the rest to the next step.
    """
    cores = [{"core": core} for core in _list_other_cores(rack, rack.config.board[board].core)]
    places = list(_list_loose_couplings(rack, board))
    older = [{"within_cycles": d} for d in _list_plan_cycles(rack.timing.levels[board])]
    kinds = (
        _try_each(rack, board, _list_priorities(rack, board)),
        _try_each(rack, board, cores),
        _try_each(rack, board, places),
        _search_first(rack, board, older),
        _search_first(rack, board, _list_longer_cycles(rack, board)),
    )
    changes = [change for change in kinds if change is not None]
    if not changes:
        loosened = (rack.try_change(board, place) for place in places)
        changes = [c for c in loosened if c is not None and c.after.failing < rack.failing][:1]
    return sorted(changes, key=lambda change: change.cost)


def _list_priorities(rack: JudgedConfig, board: str) -> Iterator[Settings]:
    """Yield higher priorities for a board's executor or planner, the smallest rise first.

    Each of them is just above another task on the same core.
    """
    table = rack.config.board[board]
    limit = rack.config.clock.priority or MAX_PRIORITY + 1
    for key, task in (("priority", board), ("planner_priority", f"{board}.planner")):
        core = rack.timing.cores.get(task)
        present = getattr(table, key)
        higher = {
            other.priority + 1
            for other in rack.timing.tasks
            if other.core == core and other.name != task
        }
        yield from ({key: priority} for priority in sorted(higher) if present < priority < limit)


def _list_longer_cycles(rack: JudgedConfig, board: str) -> list[Settings]:
    """Return settings with longer cycles for a board.

    If the age of plans is limited, a longer cycle may leave fewer cycles for a plan.
    """
    timing = rack.timing
    every = timing.boards[board].every
    level = timing.levels[board]
    step = max(1, every * (MAX_FACTOR - 1) // MAX_CYCLES_TRIED)
    longest_every = min(MAX_FACTOR * every, LONGEST_EVERY)
    longer_settings: list[Settings] = []
    for longer in range(every + step, longest_every + 1, step):
        cycles = timing.boards[board].within_cycles
        changed: Settings = {}
        if level.within_cycles is not None and level.plan_within_ns is not None:
            cycles = max(min(cycles, level.plan_within_ns // (longer * timing.tick_ns)), 1)
            changed = {"within_cycles": cycles}
        # Filter before the search, because a longer cycle is not always better: it may fit the grid
        # of the other levels less well, or leave too few cycles for plans.
        if rack.is_acceptable_change(
            timing.replace_board(board, every=longer, within_cycles=cycles), board
        ):
            longer_settings.append({**changed, "every": longer, "rate_hz": None})
    return longer_settings


def _list_loose_couplings(rack: JudgedConfig, board: str) -> Iterator[Settings]:
    """Yield settings that couple the board's planner loosely, one for each core it could use."""
    slot = rack.config.board[board].planner_slot
    if slot is None:
        slot = next(iter(rack.config.list_free_slots()), None)
    if rack.timing.levels[board].within_cycles is not None and slot is not None:
        for core in _list_other_cores(rack, rack.timing.boards[board].planner_core):
            yield {"coupling": "loose", "planner_slot": slot, "planner_core": core}


def _list_plan_cycles(level: LevelTiming) -> range:
    """Return numbers of cycles per plan above the current number. Empty without a planner."""
    if level.within_cycles is None:
        return range(0)
    longest = min(level.within_cycles * MAX_FACTOR, MAX_CYCLES)
    if level.plan_within_ns is not None:
        longest = min(level.plan_within_ns // level.cycle_ns, longest)
    return range(level.within_cycles + 1, longest + 1)


def _list_other_cores(rack: JudgedConfig, core: int) -> Iterator[int]:
    """Yield the cores to which a task could move.

    Cores in use come first, sorted by ascending load, followed by one unused core. The cores of a
    board without a budget are left out, because their free time is unknown.
    """
    timing = rack.timing
    used = set(timing.cores.values())
    unknown = {
        core
        for name in timing.boards.keys() - timing.levels.keys()
        for core in timing.find_cores(name)
    }
    yield from sorted(
        used - unknown - {core}, key=lambda other: (timing.loads.get(other, 0.0), other)
    )
    yield next(free for free in range(len(used) + 1) if free not in used)


def _try_change(rack: JudgedConfig, board: str, settings: Settings) -> Change | None:
    """Return the change of a board if it removes all failures of the board, else None."""
    change = rack.try_change(board, settings)
    failing = rack.failing if change is None else change.after.failing
    return change if failing < rack.failing and not failing & rack.find_failures(board) else None


def _try_each(rack: JudgedConfig, board: str, tried: Iterable[Settings]) -> Change | None:
    """Return the first change that `_try_change` accepts, or None."""
    changes = (_try_change(rack, board, settings) for settings in tried)
    return next((change for change in changes if change is not None), None)


def _search_first(rack: JudgedConfig, board: str, tried: Sequence[Settings]) -> Change | None:
    """Return the first change that `_try_change` accepts, or None.

    The search by bisection requires that all settings after acceptable ones are also acceptable.
    """
    at = bisect_left(tried, True, key=lambda one: _try_change(rack, board, one) is not None)
    return _try_each(rack, board, tried[at : at + 1])
