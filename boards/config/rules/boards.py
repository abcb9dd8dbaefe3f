"""Boards and host boards: names, neighbours, planners and slots; their rates, the clock, and a
static schedule.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from graphlib import CycleError, TopologicalSorter

from rack.backplane.address_map import CLOCK
from rack.backplane.clock.system_clock import rate_text
from rack.backplane.errors import ClockError
from rack.boards.config.connections import Wiring
from rack.boards.config.files import LAN_ADAPTER
from rack.boards.config.mistakes import repeated
from rack.boards.config.record import RecordConfig
from rack.boards.config.schema import (
    LAN,
    LONGEST_EVERY,
    SHORTEST_MS,
    BoardConfig,
    RackConfig,
    ScheduleConfig,
)
from rack.boards.config.timing import PLANNER_BUDGET, frames
from rack.boards.errors import Mistake, Mistakes

RESERVED = (CLOCK, "above", "below", "own")
"""Names with a special meaning in the wiring of ports."""
PLANNER_TRANSFER = ("exchange_ms", "update_ms")
BOARD_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")


def boards(wiring: Wiring) -> Mistakes:
    """Check the name, the neighbours and the planner of each board."""
    known = [*wiring.config.board, *wiring.broken_boards]
    for name, board in wiring.config.board.items():
        place = f"board.{name}"
        yield from _name(place, name)
        others = [other for other in known if other != name]
        for key, neighbours in (("above", board.above), ("below", board.below)):
            yield from _neighbours(f"{place}.{key}", neighbours, others, "other board")
        yield from _planner(place, board)
        if board.executor == LAN_ADAPTER and (name != LAN or wiring.config.adapter.lan is None):
            why = "permitted: [adapter.lan], which makes its board"
            yield Mistake(f"{place}.executor", board.executor, why)


def hosts(wiring: Wiring) -> Mistakes:
    """Check the name and the neighbours of each host board."""
    known = [*wiring.config.board, *wiring.broken_boards]
    for name, host in wiring.config.host.items():
        place = f"host.{name}"
        yield from _name(place, name)
        if name in known:
            yield Mistake(place, None, f"board.{name} has this name already")
        yield from _neighbours(f"{place}.below", host.below, known, "board")


def _neighbours(place: str, names: Sequence[str], boards: Sequence[str], what: str) -> Mistakes:
    for name in names:
        if name not in boards:
            yield Mistake(
                place, name, f"no {what} has this name; boards: {', '.join(boards) or 'none'}"
            )
    yield from repeated(place, names)


def _name(place: str, name: str) -> Mistakes:
    if not BOARD_NAME.fullmatch(name) or name in RESERVED:
        why = f"permitted: a-z, 0-9 and _, at most 31, except {', '.join(RESERVED)}"
        yield Mistake(place, None, f"invalid name for a board; {why}")


def _planner(place: str, board: BoardConfig) -> Mistakes:
    has_planner = board.planner is not None
    is_loose = board.coupling == "loose"
    if has_planner != (board.coupling != "none"):
        permitted = (
            '"tight" or "loose" with a planner' if has_planner else '"none" without a planner'
        )
        yield Mistake(f"{place}.coupling", board.coupling, f"permitted: {permitted}")
    if is_loose and board.planner_slot is None:
        yield Mistake(
            f"{place}.planner_slot", None, "missing; a loosely coupled planner has its own board"
        )
    for key in ("planner_slot", "planner_core"):
        if not is_loose and getattr(board, key) is not None:
            yield Mistake(
                f"{place}.{key}", getattr(board, key), 'only for a planner with coupling = "loose"'
            )
    if board.coupling == "tight" and board.planner_priority >= max(board.priority, 1):
        why = (
            f"must be below the executor's priority, {board.priority}, with a tightly coupled"
            " planner"
        )
        yield Mistake(f"{place}.planner_priority", board.planner_priority, why)
    if not has_planner:
        # Otherwise such a time would be ignored silently.
        for table, keys in (("budget", PLANNER_BUDGET), ("transfer", PLANNER_TRANSFER)):
            for key in keys:
                if value := getattr(getattr(board, table), key, None):
                    yield Mistake(
                        f"{place}.{table}.{key}",
                        value,
                        "the board has no planner; remove it, or add one",
                    )


def circles(wiring: Wiring) -> Mistakes:
    """Find a circle among levels: a walk from level to level would not end."""
    config = wiring.config
    links = list(config.links())
    try:
        TopologicalSorter(
            {name: [upper for upper, lower in links if lower == name] for name in config.board}
        ).prepare()
    except CycleError as error:
        circle = error.args[1][:-1]
        pairs = list(zip(circle, [*circle[1:], circle[0]], strict=True))
        # The link that only one of its boards names is the likely mistake.
        upper, lower = min(reversed(pairs), key=lambda link: len(_named_by(config, *link)))
        board, key, end = _named_by(config, upper, lower)[0]
        at = circle.index(lower)
        walk = " -> ".join([*circle[at:], *circle[:at], lower])
        why = f"the levels form a circle, {walk}; the {end} level has no {key}"
        other = upper if board == lower else lower
        yield Mistake(f"board.{board}.{key}", other, why)


def _named_by(config: RackConfig, upper: str, lower: str) -> list[tuple[str, str, str]]:
    """Return board and key of every table that puts one board above another, and the end of a
    hierarchy without it.
    """
    tables = ((upper, "below", "lowest", lower), (lower, "above", "highest", upper))
    return [
        (board, key, end)
        for board, key, end, other in tables
        if other in getattr(config.board[board], key)
    ]


def slots(wiring: Wiring) -> Mistakes:
    """Check that each slot holds one board."""
    taken: dict[int, str] = {}
    for name, board in wiring.config.board.items():
        for key, slot in (("slot", board.slot), ("planner_slot", board.planner_slot)):
            place = f"board.{name}.{key}"
            if slot is not None and slot in taken:
                yield Mistake(place, slot, f"already taken by {taken[slot]}")
            elif slot is not None:
                taken[slot] = place


def ends(wiring: Wiring) -> Mistakes:
    """Check that no more than one board ends the run."""
    ending = [name for name, board in wiring.config.board.items() if board.ends_run]
    for name in ending[1:]:
        yield Mistake(
            f"board.{name}.ends_run",
            True,
            f"only one board can end the run; '{ending[0]}' already does",
        )


def record(wiring: Wiring) -> Mistakes:
    """Check that a recording which keeps everything is not asked for what surrounds a fault."""
    table = wiring.config.record
    if table.keep is None:
        for key in ("before", "after"):
            if (value := getattr(table, key)) != RecordConfig.model_fields[key].default:
                yield Mistake(f"record.{key}", value, "needs record.keep; without it all is kept")


LONGEST_MAJOR = 10_000
"""Longest major frame, ticks: the timing model computes two of them."""


def clock(wiring: Wiring) -> Mistakes:
    """Check the tick in simulated time and in real time."""
    config = wiring.config
    clock = wiring.config.clock
    if abs(clock.period_ms * 1e6 - config.clock_ns) > 1e-3:
        yield Mistake("clock.period_ms", clock.period_ms, "not a whole number of ns")
    if config.is_lockstep and clock.speed != 1.0:
        yield Mistake(
            "clock.speed",
            clock.speed,
            'lockstep runs as fast as it can; speed needs mode = "realtime"',
        )
    tick_ms = clock.period_ms / clock.speed
    if tick_ms < SHORTEST_MS:
        why = (
            f"a tick would take {tick_ms:g} ms of real time; permitted: {SHORTEST_MS:g} ms or more"
        )
        yield Mistake("clock.speed", clock.speed, why)


def rates(wiring: Wiring) -> Mistakes:
    """Check that the period of each board is given once, is on the clock's grid, and is not too
    long.
    """
    for name, board in wiring.config.board.items():
        place = f"board.{name}.rate_hz"
        if (board.rate_hz is None) == (board.every is None):
            why = "missing; give rate_hz (Hz) or every (ticks)"
            if board.every is not None:
                why = "every is also given; permitted: one of rate_hz, every"
            yield Mistake(place, board.rate_hz, why)
            continue
        try:
            every = wiring.config.every(name)
        except ClockError as error:
            yield Mistake(place, None, str(error))
            continue
        if every > LONGEST_EVERY:
            yield Mistake(
                place,
                board.rate_hz,
                f"a cycle would take {every} ticks; permitted: up to {LONGEST_EVERY}",
            )
        if board.phase >= every:
            why = f"must be less than the board's period; permitted: 0 to {every - 1} ticks"
            yield Mistake(f"board.{name}.phase", board.phase, why)


def polling(wiring: Wiring) -> Mistakes:
    """Refuse a board that busy-waits on a shared core: at a real-time priority it would starve the
    others.
    """
    config = wiring.config
    cores = {CLOCK: config.clock.core} | {place.name: place.core for place in config.tasks()}
    for name, board in config.board.items():
        others = [other for other, core in cores.items() if core == board.core and other != name]
        if (board.wake or config.clock.wake) == "poll" and others:
            why = f"needs a core of its own, but shares core {board.core} with: {', '.join(others)}"
            yield Mistake(f"board.{name}.wake", "poll", why)


def reservations(wiring: Wiring) -> Mistakes:
    """Check that each board can reserve processor time, if the clock's scheduler needs that."""
    config = wiring.config
    if config.clock.scheduler == "fixed-priority":
        return
    if not config.timing.clock_ms:
        yield Mistake("timing.clock_ms", 0.0, "missing; the clock reserves twice as much")
    for name, board in config.board.items():
        place = f"board.{name}"
        if not board.busy_ms:
            yield Mistake(f"{place}.budget", None, "missing; the board reserves twice as much")
        if (board.wake or config.clock.wake) == "poll":
            yield Mistake(f"{place}.wake", "poll", "busy-waiting uses up what it reserves")
        if board.coupling == "tight":
            why = "its planner's update takes the executor's priority, which reservations precede"
            yield Mistake(f"{place}.coupling", "tight", why)
        if board.executor == LAN_ADAPTER:
            why = "not with a network, whose threads need the adapter's priority"
            yield Mistake("clock.scheduler", config.clock.scheduler, why)


def schedule(wiring: Wiring) -> Mistakes:
    """Check a static schedule; its boards only if its frames are right."""
    table = wiring.config.schedule
    if table is not None:
        found = list(_frames(table, wiring.config.clock_ns))
        yield from found or _cycles(wiring, table)


def _frames(table: ScheduleConfig, clock_ns: int) -> Mistakes:
    tick_ms = clock_ns * 1e-6
    minor, major = frames(table, clock_ns)
    if minor < 1 or abs(minor * tick_ms - table.minor_ms) > 1e-6 * tick_ms:
        why = (
            f"not a whole number of ticks of {tick_ms:g} ms; nearest:"
            f" {_nearest(table.minor_ms, tick_ms)} ms"
        )
        yield Mistake("schedule.minor_ms", table.minor_ms, why)
    elif major % minor or not major or abs(major * tick_ms - table.major_ms) > 1e-6 * tick_ms:
        near = _nearest(table.major_ms, table.minor_ms)
        why = f"not a multiple of minor_ms, {table.minor_ms:g} ms; nearest: {near} ms"
        yield Mistake("schedule.major_ms", table.major_ms, why)
    elif major > LONGEST_MAJOR:
        why = f"{major} ticks; permitted: up to {LONGEST_MAJOR}, {LONGEST_MAJOR * tick_ms:g} ms"
        yield Mistake("schedule.major_ms", table.major_ms, why)


def _nearest(value: float, step: float) -> str:
    """Return the multiples of `step` next to a value that is none."""
    below = int(value / step)
    return " or ".join(f"{number * step:.12g}" for number in (below, below + 1) if number)


def _cycles(wiring: Wiring, table: ScheduleConfig) -> Mistakes:
    clock_ns = wiring.config.clock_ns
    minor, major = frames(table, clock_ns)
    tick_ms = clock_ns * 1e-6
    fitting = [
        minor * number for number in range(1, major // minor + 1) if major % (minor * number) == 0
    ]
    for name, every in wiring.every.items():
        if every in fitting:
            continue
        board = wiring.config.board[name]
        key = "rate_hz" if board.every is None else "every"
        below = [cycle for cycle in fitting if cycle < every]
        above = [cycle for cycle in fitting if cycle > every]
        rates = " or ".join(
            f"{(ms := cycle * tick_ms):g} ms, "
            + (f"{rate_text(1e3 / ms)} Hz" if key == "rate_hz" else f"every {cycle}")
            for cycle in (*below[-1:], *above[:1])
        )
        why = (
            f"a cycle of {every * tick_ms:g} ms does not fit the schedule, a multiple of the minor"
            f" frame, {table.minor_ms:g} ms, that divides the major one, {table.major_ms:g} ms;"
            f" nearest: {rates}"
        )
        yield Mistake(f"board.{name}.{key}", getattr(board, key), why)
