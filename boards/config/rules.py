"""What the tables of a config must agree on, beyond what each one permits by itself.

Each rule yields mistakes; together they report every mistake at once. A rule leaves out what a broken
table would tell it: that table's own mistakes are reported already.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator

from rack.backplane.errors import ClockError
from rack.boards.config.files import file_at
from rack.boards.config.schema import LONGEST_EVERY, SHORTEST_MS, BoardConfig, RackConfig
from rack.boards.errors import Mistake

RESERVED = ("clock", "above", "below", "own")
"""No board can be called so: they mean something in the wiring of ports."""
PLANNER_BUDGET = ("exchange_ms", "plan_ms", "update_ms", "plan_within_ms")
PLANNER_TRANSFER = ("exchange_ms", "update_ms")
BOARD_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")


def mistakes_in(config: RackConfig, broken: frozenset[str] = frozenset()) -> list[Mistake]:
    """Return every disagreement between the tables of `config`; `broken` names tables that it lacks."""
    boards = list(config.board.items())
    known = [*config.board, *(place.removeprefix("board.") for place in broken if place.startswith("board."))]
    found = [
        *(mistake for name, board in boards for mistake in _board(name, board, known)),
        *_circles(config),
        *_slots(config),
        *_ends(config),
        *(_scene(config) if "scene" not in broken else ()),
        *(_robot(config) if "robot" not in broken else ()),
    ]
    if "clock" not in broken:
        found += [*_clock(config), *_rates(config), *_polling(config)]
    return found


def _board(name: str, board: BoardConfig, known: list[str]) -> Iterator[Mistake]:
    place = f"board.{name}"
    if not BOARD_NAME.fullmatch(name) or name in RESERVED:
        why = f"no name for a board; permitted: a-z, 0-9 and _, at most 31, none of {', '.join(RESERVED)}"
        yield Mistake(place, None, why)
    for key, other in (("above", board.above), ("below", board.below)):
        if other is not None and (other == name or other not in known):
            yield Mistake(f"{place}.{key}", other, f"no other board is called so; boards: {_others(known, name)}")
    yield from _planner(place, board)


def _circles(config: RackConfig) -> Iterator[Mistake]:
    """Levels that are above themselves, by way of others: what walks from level to level would not end."""
    for key in ("below", "above"):
        links = {name: getattr(board, key) for name, board in config.board.items()}
        seen: set[str] = set()
        for name in links:
            walk: list[str] = []
            at: str | None = name
            while at in links and at not in seen:
                seen.add(at)
                walk.append(at)
                at = links[at]
            circle = walk[walk.index(at) :] if at in walk else []
            if len(circle) > 1:
                way = " -> ".join([*circle, circle[0]])
                why = (
                    f"the levels go round in a circle, {way}; the {'lowest' if key == 'below' else 'highest'} has none"
                )
                yield Mistake(f"board.{circle[-1]}.{key}", circle[0], why)


def _others(known: list[str], name: str) -> str:
    return ", ".join(other for other in known if other != name) or "none"


def _planner(place: str, board: BoardConfig) -> Iterator[Mistake]:
    has_planner, is_loose = board.planner is not None, board.coupling == "loose"
    if has_planner != (board.coupling != "none"):
        permitted = '"tight" or "loose", as there is a planner' if has_planner else '"none", as there is no planner'
        yield Mistake(f"{place}.coupling", board.coupling, f"permitted: {permitted}")
    if is_loose and board.planner_slot is None:
        yield Mistake(f"{place}.planner_slot", None, "missing; a loosely coupled planner has a board of its own")
    for key in ("planner_slot", "planner_core"):
        if not is_loose and getattr(board, key) is not None:
            yield Mistake(f"{place}.{key}", getattr(board, key), 'only a planner with coupling = "loose" has one')
    if board.coupling == "tight" and board.planner_priority >= max(board.priority, 1):
        why = f"a tightly coupled planner runs below its executor, whose priority is {board.priority}"
        yield Mistake(f"{place}.planner_priority", board.planner_priority, why)
    if not has_planner:
        yield from _without_planner(place, board)


def _without_planner(place: str, board: BoardConfig) -> Iterator[Mistake]:
    """What the planner that is not there would take; nobody would notice that it is not counted."""
    for table, keys in (("budget", PLANNER_BUDGET), ("transfer", PLANNER_TRANSFER)):
        for key in keys:
            value = getattr(getattr(board, table), key, None)
            if value:
                yield Mistake(f"{place}.{table}.{key}", value, "the board has no planner; leave it out, or name one")


def _slots(config: RackConfig) -> Iterator[Mistake]:
    taken: dict[int, str] = {}
    for name, board in config.board.items():
        for key, slot in (("slot", board.slot), ("planner_slot", board.planner_slot)):
            place = f"board.{name}.{key}"
            if slot is not None and slot in taken:
                yield Mistake(place, slot, f"the slot is taken by {taken[slot]}")
            elif slot is not None:
                taken[slot] = place


def _ends(config: RackConfig) -> Iterator[Mistake]:
    ending = [name for name, board in config.board.items() if board.ends_run]
    for name in ending[1:]:
        yield Mistake(f"board.{name}.ends_run", True, f"one board ends the run, and '{ending[0]}' does already")


def _clock(config: RackConfig) -> Iterator[Mistake]:
    clock = config.clock
    if abs(clock.period_ms * 1e6 - config.clock_ns) > 1e-3:
        yield Mistake("clock.period_ms", clock.period_ms, "is no whole number of ns")
    if clock.mode == "lockstep" and clock.speed != 1.0:
        yield Mistake("clock.speed", clock.speed, 'lockstep runs as fast as it can; a speed needs mode = "realtime"')
    if clock.period_ms / clock.speed < SHORTEST_MS:
        why = (
            f"makes a tick of {clock.period_ms / clock.speed:g} ms in real time; permitted: {SHORTEST_MS:g} ms or more"
        )
        yield Mistake("clock.speed", clock.speed, why)


def _rates(config: RackConfig) -> Iterator[Mistake]:
    for name, board in config.board.items():
        place = f"board.{name}.rate_hz"
        if (board.rate_hz is None) == (board.every is None):
            why = "missing; give rate_hz, Hz, or every, ticks" if board.every is None else "every is given as well"
            yield Mistake(place, board.rate_hz, why)
            continue
        try:
            every = config.every(name)
        except ClockError as error:
            yield Mistake(place, None, str(error))
        else:
            if every > LONGEST_EVERY:
                yield Mistake(place, board.rate_hz, f"makes a cycle of {every} ticks; permitted: {LONGEST_EVERY}")


def _polling(config: RackConfig) -> Iterator[Mistake]:
    """A board that busy-waits under a real-time priority would starve whatever shares its core."""
    cores = {name: board.core for name, board in config.board.items()}
    cores["clock"] = config.clock.core
    for name, board in config.board.items():
        if board.coupling == "loose" and board.planner_core is not None:
            cores[f"{name}.planner"] = board.planner_core
        elif board.planner is not None:
            cores[f"{name}.planner"] = board.core
    for name, board in config.board.items():
        others = [other for other, core in cores.items() if core == board.core and other != name]
        if (board.wake or config.clock.wake) == "poll" and others:
            why = f"needs a core of its own; core {board.core} has also: {', '.join(others)}"
            yield Mistake(f"board.{name}.wake", "poll", why)


def _robot(config: RackConfig) -> Iterator[Mistake]:
    robot = config.robot
    if robot is None:
        return
    if file_at(robot.model) is None:
        yield Mistake("robot.model", str(robot.model), "no such file")
    for key in ("home", "velocity", "acceleration", "jerk", "torque", "position"):
        values = getattr(robot, key)
        if values is not None and len(values) != len(robot.joints):
            why = f"{len(values)} values; one a joint makes {len(robot.joints)}"
            yield Mistake(f"robot.{key}", list(values), why)
    for key, values in robot.sensors:
        if isinstance(values, tuple) and len(values) != len(robot.joints):
            why = f"{len(values)} values; permitted: one for all joints, or one a joint: {len(robot.joints)}"
            yield Mistake(f"robot.sensors.{key}", list(values), why)
    yield from _repeated("robot.joints", robot.joints)


def _scene(config: RackConfig) -> Iterator[Mistake]:
    scene = config.scene
    for at, motion in enumerate(scene.motion):
        if motion.body not in scene.obstacles:
            why = f"no obstacle is called so; scene.obstacles: {', '.join(scene.obstacles) or 'none'}"
            yield Mistake(f"scene.motion[{at}].body", motion.body, why)
    yield from _repeated("scene.objects and scene.obstacles", scene.bodies)


def _repeated(place: str, names: tuple[str, ...]) -> Iterator[Mistake]:
    for name, count in Counter(names).items():
        if count > 1:
            yield Mistake(place, name, f"stands there {count} times")
