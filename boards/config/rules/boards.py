"""Rules for boards and host boards: names, neighbours, planners, slots, rates and schedule."""

from __future__ import annotations

import re
from bisect import bisect
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.system_clock import format_rate
from rack.backplane.errors import ClockError
from rack.backplane.words import Scheduler
from rack.boards.config.connections import Wiring
from rack.boards.config.files import LAN_ADAPTER
from rack.boards.config.mistakes import report_repeated_names
from rack.boards.config.schedulers import (
    find_scheduler,
    list_reservation_mistakes,
    list_valid_schedulers,
    names_scheduler,
)
from rack.boards.config.schema import (
    LAN,
    LONGEST_EVERY,
    BoardConfig,
)
from rack.boards.config.times import SHORTEST_MS, ScheduleConfig
from rack.boards.config.timing import PLANNER_BUDGET, compute_frames
from rack.boards.errors import Mistake, Mistakes

RESERVED = (CLOCK, "above", "below", "own")
"""Names that no board may have, because they have a meaning in the wiring of ports."""
PLANNER_TRANSFER = ("exchange_ms", "update_ms")
BOARD_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")


def check_boards(wiring: Wiring) -> Mistakes:
    """Check that boards have valid names, neighbours that exist, and consistent planner keys.

    Host boards must also have unused names.
    """
    config = wiring.config
    known = [*config.board, *wiring.broken_boards]
    for name, board in config.board.items():
        place = f"board.{name}"
        yield from _check_name(place, name)
        others = [other for other in known if other != name]
        for key, neighbours in (("above", board.above), ("below", board.below)):
            yield from _check_neighbours(f"{place}.{key}", neighbours, others, "other board")
        yield from _check_planner(place, board)
        if board.executor == LAN_ADAPTER and (name != LAN or config.adapter.lan is None):
            why = "this class needs the table [adapter.lan], which adds its board"
            yield Mistake(f"{place}.executor", board.executor, why)
    for name, host in config.host.items():
        place = f"host.{name}"
        yield from _check_name(place, name)
        if name in known:
            yield Mistake(place, None, f"board.{name} already has this name")
        yield from _check_neighbours(f"{place}.below", host.below, known, "board")


def _check_neighbours(
    place: str, names: Sequence[str], boards: Sequence[str], noun: str
) -> Mistakes:
    """Check that the neighbours of a board exist and that none is listed twice.

    Args:
        place: Place of the neighbours in the config.
        names: The listed neighbours.
        boards: Boards that may be listed.
        noun: Noun for a neighbour in the text of a mistake, such as "other board".
    """
    for name in names:
        if name not in boards:
            yield Mistake(
                place, name, f"no {noun} has this name; boards: {', '.join(boards) or 'none'}"
            )
    yield from report_repeated_names(place, names)


def _check_name(place: str, name: str) -> Mistakes:
    """Check that a board or host board has a valid name that is not reserved."""
    if not BOARD_NAME.fullmatch(name) or name in RESERVED:
        why = f"valid: at most 31 of a-z, 0-9 and _, except {', '.join(RESERVED)}"
        yield Mistake(place, None, f"invalid name for a board; {why}")


def _check_planner(place: str, board: BoardConfig) -> Mistakes:
    """Check that a board's planner keys fit its coupling. Without a planner it must have none."""
    has_planner = board.planner is not None
    is_loose = board.coupling == "loose"
    if has_planner != (board.coupling != "none"):
        valid = '"tight" or "loose" with a planner' if has_planner else '"none" without a planner'
        yield Mistake(f"{place}.coupling", board.coupling, f"must be {valid}")
    if is_loose and board.planner_slot is None:
        why = "missing; a loosely coupled planner has its own board"
        yield Mistake(f"{place}.planner_slot", None, why)
    for key in () if is_loose else ("planner_slot", "planner_core"):
        if (value := getattr(board, key)) is not None:
            yield Mistake(f"{place}.{key}", value, 'only for a planner with coupling = "loose"')
    if board.coupling == "tight" and board.planner_priority >= max(board.priority, 1):
        why = (
            f"must be below the executor's priority, {board.priority}, with a tightly coupled"
            " planner"
        )
        yield Mistake(f"{place}.planner_priority", board.planner_priority, why)
    if not has_planner:
        # Without a planner, these times would be ignored silently.
        for table, keys in (("budget", PLANNER_BUDGET), ("transfer", PLANNER_TRANSFER)):
            for key in keys:
                if value := getattr(getattr(board, table), key, None):
                    why = "the board has no planner; remove it, or add one"
                    yield Mistake(f"{place}.{table}.{key}", value, why)


def check_circles(wiring: Wiring) -> Mistakes:
    """Check that no level is above itself, directly or through other levels."""
    config = wiring.config
    above: dict[str, list[str]] = {name: [] for name in config.board}
    for upper, lower in config.list_links():
        above[lower].append(upper)
    try:
        TopologicalSorter(above).prepare()
    except CycleError as error:
        # The last level is the first again. Each is above the next.
        circle = error.args[1]
        declared = [
            keys
            for upper, lower in pairwise(circle)
            if (
                keys := [
                    (f"board.{board}.{key}", other)
                    for board, key, other in ((upper, "below", lower), (lower, "above", upper))
                    if other in getattr(config.board[board], key)
                ]
            )
        ]
        # Prefer to report a link that only one of its two boards names.
        place, other = min(reversed(declared), key=len)[0]
        yield Mistake(place, other, f"the levels form a circle, {' -> '.join(circle)}")


def check_slots(wiring: Wiring) -> Mistakes:
    """Check that no two boards have the same slot."""
    config = wiring.config
    slots = [
        (f"board.{name}.{key}", slot)
        for name, board in config.board.items()
        for key, slot in (("slot", board.slot), ("planner_slot", board.planner_slot))
    ]
    taken: dict[int, str] = {}
    standbys = [(f"{place}.slot", standby.slot) for place, standby in config.list_standby_tables()]
    for place, slot in (*slots, *standbys):
        if slot is not None and slot in taken:
            yield Mistake(place, slot, f"the slot is already taken by {taken[slot]}")
        elif slot is not None:
            taken[slot] = place


def check_run_end(wiring: Wiring) -> Mistakes:
    """Check that at most one board ends the run."""
    ending = [name for name, board in wiring.config.board.items() if board.ends_run]
    for name in ending[1:]:
        why = f"only one board can end the run; '{ending[0]}' already does"
        yield Mistake(f"board.{name}.ends_run", True, why)


LONGEST_MAJOR = 10_000
"""Longest major frame in ticks. The timing model simulates two major frames."""


def check_clock(wiring: Wiring) -> Mistakes:
    """Check that a tick is a whole number of ns and not too short in real time.

    In lockstep, `speed` must be 1.
    """
    config = wiring.config
    clock = config.clock
    if abs(clock.period_ms * 1e6 - config.clock_ns) > 1e-3:
        yield Mistake("clock.period_ms", clock.period_ms, "not a whole number of ns")
    if config.is_lockstep and clock.speed != 1.0:
        why = 'lockstep runs as fast as it can; speed needs mode = "realtime"'
        yield Mistake("clock.speed", clock.speed, why)
    tick_ms = clock.period_ms / clock.speed
    if tick_ms < SHORTEST_MS:
        why = (
            f"a tick would take {tick_ms:g} ms of real time; at least {SHORTEST_MS:g} ms are valid"
        )
        yield Mistake("clock.speed", clock.speed, why)


def check_rates(wiring: Wiring) -> Mistakes:
    """Check that each board has a valid period and a phase smaller than its period.

    Exactly one of `rate_hz` and `every` must be given. The period must be a whole number of ticks,
    at most `LONGEST_EVERY`.
    """
    for name, board in wiring.config.board.items():
        place = f"board.{name}.rate_hz"
        if (board.rate_hz is None) == (board.every is None):
            why = "missing; give rate_hz (Hz) or every (ticks)"
            if board.every is not None:
                why = "every is also given; give only one of rate_hz, every"
            yield Mistake(place, board.rate_hz, why)
            continue
        try:
            every = wiring.config.find_period(name)
        except ClockError as error:
            yield Mistake(place, None, str(error))
            continue
        if every > LONGEST_EVERY:
            why = f"a cycle would take {every} ticks; it can take up to {LONGEST_EVERY}"
            yield Mistake(place, board.rate_hz, why)
        if board.phase >= every:
            why = f"must be less than the board's period: 0 to {every - 1} ticks"
            yield Mistake(f"board.{name}.phase", board.phase, why)


def check_polling(wiring: Wiring) -> Mistakes:
    """Check that a board that busy-waits has a core to itself.

    Otherwise it would starve the other tasks on its core.
    """
    config = wiring.config
    places = (*config.list_tasks(), *config.list_standbys())
    cores = {CLOCK: config.clock.core} | {place.name: place.core for place in places}
    for name, board in config.board.items():
        others = [other for other, core in cores.items() if core == board.core and other != name]
        if (board.wake or config.clock.wake) == "poll" and others:
            why = f"polling needs a core to itself; core {board.core} also runs {', '.join(others)}"
            yield Mistake(f"board.{name}.wake", "poll", why)


def check_schedulers(wiring: Wiring) -> Mistakes:
    """Check that each board can have its scheduler, and can take simulated time if it has to."""
    config = wiring.config
    reported = set[str]()
    load = config.simulated_load
    if load and not names_scheduler(config):
        yield Mistake("timing.lockstep_load", load, "needs clock.scheduler, which is missing")
    for name, board in config.board.items():
        scheduler = find_scheduler(config, name)
        key = "clock.scheduler" if board.scheduler is None else f"board.{name}.scheduler"
        if scheduler.word not in list_valid_schedulers(config) and key not in reported:
            reported.add(key)
            valid = " or ".join(list_valid_schedulers(config))
            why = f"Linux has no such scheduler; in real time use {valid}"
            yield Mistake(key, scheduler.word, why)
        if scheduler is Scheduler.EARLIEST_DEADLINE_FIRST:
            if not config.timing.clock_ms and "timing" not in reported:
                reported.add("timing")
                yield Mistake("timing.clock_ms", 0.0, "missing; the clock reserves twice this time")
            yield from list_reservation_mistakes(config, name, key)
        elif load and not board.busy_ms:
            why = "missing; a cycle takes this time, times timing.lockstep_load"
            yield Mistake(f"board.{name}.budget", None, why)
        if load and board.planner is not None and not board.planning_ms:
            why = "missing; a plan takes this time, times timing.lockstep_load"
            yield Mistake(f"board.{name}.budget.plan_ms", None, why)


def check_schedule(wiring: Wiring) -> Mistakes:
    """If the rack has a static schedule, check its frames and the boards' cycles in them.

    The minor frame must be a whole number of ticks, the major frame a multiple of it and at most
    `LONGEST_MAJOR`. Each board's cycle must be a multiple of the minor frame and divide the major.
    """
    table = wiring.config.schedule
    if table is None:
        return
    tick_ms = wiring.config.clock_ns * 1e-6
    minor, major = compute_frames(table, wiring.config.clock_ns)
    if minor < 1 or abs(minor * tick_ms - table.minor_ms) > 1e-6 * tick_ms:
        near = _format_nearest(table.minor_ms, tick_ms)
        why = f"not a whole number of ticks of {tick_ms:g} ms; nearest: {near} ms"
        yield Mistake("schedule.minor_ms", table.minor_ms, why)
    elif major % minor or not major or abs(major * tick_ms - table.major_ms) > 1e-6 * tick_ms:
        near = _format_nearest(table.major_ms, table.minor_ms)
        why = f"not a multiple of minor_ms, {table.minor_ms:g} ms; nearest: {near} ms"
        yield Mistake("schedule.major_ms", table.major_ms, why)
    elif major > LONGEST_MAJOR:
        longest = f"{LONGEST_MAJOR} ticks, {LONGEST_MAJOR * tick_ms:g} ms"
        why = f"{major} ticks are too long; the longest major frame is {longest}"
        yield Mistake("schedule.major_ms", table.major_ms, why)
    else:
        yield from _check_cycles(wiring, table, minor, major)


def _format_nearest(value: float, step: float) -> str:
    """Return the positive multiples of `step` just below and above `value`, as text."""
    below = int(value / step)
    return " or ".join(f"{number * step:.12g}" for number in (below, below + 1) if number)


def _check_cycles(wiring: Wiring, table: ScheduleConfig, minor: int, major: int) -> Mistakes:
    """Check that each board's cycle is a multiple of the minor frame and divides the major."""
    tick_ms = wiring.config.clock_ns * 1e-6
    fitting = [cycle for cycle in range(minor, major + 1, minor) if major % cycle == 0]
    for name, every in wiring.periods.items():
        if every in fitting:
            continue
        board = wiring.config.board[name]
        key = "rate_hz" if board.every is None else "every"
        at = bisect(fitting, every)
        rates = " or ".join(
            f"{(ms := cycle * tick_ms):g} ms, "
            + (f"{format_rate(1e3 / ms)} Hz" if key == "rate_hz" else f"every {cycle}")
            for cycle in fitting[max(0, at - 1) : at + 1]
        )
        why = (
            f"a cycle of {every * tick_ms:g} ms does not fit the schedule; it must be a multiple of"
            f" the minor frame, {table.minor_ms:g} ms, that divides the major frame,"
            f" {table.major_ms:g} ms; nearest: {rates}"
        )
        yield Mistake(f"board.{name}.{key}", getattr(board, key), why)
