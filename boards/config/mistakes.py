"""Mistakes in the tables of a config: those that pydantic finds in a single table, and those between tables.

Each rule yields its mistakes, so all are reported at once. A rule skips what depends on a broken table, whose own
mistakes are already reported.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import ClockError
from rack.boards.config.files import file_at
from rack.boards.config.rules.lan import lan_mistakes
from rack.boards.config.rules.network import network_mistakes
from rack.boards.config.rules.schedule import schedule_mistakes
from rack.boards.config.schema import LONGEST_EVERY, SHORTEST_MS, BoardConfig, HostConfig, RackConfig
from rack.boards.errors import Mistake

RESERVED = (CLOCK, "above", "below", "own")
"""Names with a special meaning in the wiring of ports."""
PERMITTED = f"permitted: a-z, 0-9 and _, at most 31, except {', '.join(RESERVED)}"
PLANNER_BUDGET = ("exchange_ms", "plan_ms", "update_ms", "plan_within_ms")
PLANNER_TRANSFER = ("exchange_ms", "update_ms")
BOARD_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
HINTS = {"robot": "; a [robot] with its own model is a different arm and inherits nothing from extended files"}
"""Hints for tables that lack a key."""


def mistakes_of(error: ValidationError, model: type[BaseModel], tables: Any, place: str = "") -> list[Mistake]:
    """Return the mistakes of `tables`, which are at `place` in the config and failed validation as `model`."""
    found = [_mistake(entry, model, tables, place) for entry in error.errors(include_url=False)]
    # A value that may have several types yields a mistake for each type: keep the first, or that of its item.
    first = {mistake.place: mistake for mistake in reversed(found)}
    within = {place for place in first if any(other.startswith((f"{place}[", f"{place}.")) for other in first)}
    return [first[place] for place in reversed(first) if place not in within]


def _mistake(entry: ErrorDetails, model: type[BaseModel], tables: Any, place: str) -> Mistake:
    keys = _keys(entry["loc"], tables, entry["type"] == "missing")
    where = (place + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)).lstrip(".")
    if entry["type"].startswith("union_tag"):  # a table of several kinds, selected by one key
        about = entry["ctx"]
        permitted = about.get("expected_tags", "").replace("'", "")
        why = f"permitted: {permitted}" if permitted else "missing; it selects the kind of table"
        return Mistake(f"{where}.{about['discriminator'].strip(chr(39))}", about.get("tag"), why)
    known, field = _declared(model, keys, tables)
    meaning = f"; {field.description}" if field is not None and field.description else ""
    if entry["type"] == "missing":
        return Mistake(where, None, f"missing{meaning}{HINTS.get(str(keys[0]), '')}")
    if entry["type"] == "extra_forbidden":
        near = difflib.get_close_matches(str(keys[-1]), known, 1)
        why = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        return Mistake(where, entry["input"], f"unknown key; {why}")
    text = entry["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("valid tuple", "list")
    if entry["type"] == "value_error" and isinstance(entry["input"], dict):
        return Mistake(where, None, text)
    return Mistake(where, entry["input"], f"{text}{meaning}")


def _keys(loc: tuple[int | str, ...], table: Any, is_missing: bool) -> list[int | str]:
    """Return the keys of a location without the names of variants that pydantic inserts."""
    keys: list[int | str] = []
    for key in loc:
        in_list = isinstance(table, list) and isinstance(key, int) and key < len(table)
        if in_list or (isinstance(table, dict) and key in table):
            table = table[key]
            keys.append(key)
    return [*keys, loc[-1]] if is_missing else keys


def _declared(model: type[BaseModel], keys: list[int | str], table: Any) -> tuple[list[str], FieldInfo | None]:
    """Return the names of all keys of the table that contains the last of `keys`, and that key's field."""
    models, known, field, is_name = [model], dict[str, FieldInfo](), None, False
    for key in keys:
        models = [kind for kind in models if _fits(kind, table)] or models
        try:
            table = table[key]
        except (LookupError, TypeError):  # missing, or not a table
            table = None
        if isinstance(key, int):
            continue
        if is_name:  # the name of a table among tables of one type, as in [board.servo]
            is_name = False
            continue
        known = {f.alias or name: f for kind in models for name, f in kind.model_fields.items()}
        field = known.get(key)
        models = list(_models(field.annotation)) if field is not None else []
        is_name = field is not None and get_origin(field.annotation) is dict
    return list(known), field


def _fits(kind: type[BaseModel], table: Any) -> bool:
    """Say whether a table may be of this kind, judged by its keys with fixed values, as in do = "goto"."""
    fixed = {key: get_args(f.annotation) for key, f in kind.model_fields.items() if get_origin(f.annotation) is Literal}
    return isinstance(table, dict) and all(table.get(key) in values for key, values in fixed.items())


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the tables in a type, as in `tuple[Transfer | Goto, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def disagreements(config: RackConfig, broken: frozenset[str] = frozenset()) -> list[Mistake]:
    """Return every disagreement between the tables of `config`; `broken` names the tables missing from it."""
    boards = list(config.board.items())
    known = [*config.board, *(place.removeprefix("board.") for place in broken if place.startswith("board."))]
    found = [
        *(mistake for name, board in boards for mistake in _board(name, board, known)),
        *(mistake for name, host in config.host.items() for mistake in _host(name, host, known)),
        *_circles(config),
        *_slots(config),
        *_ends(config),
        *lan_mistakes(config),
        *network_mistakes(config),
        *(_scene(config) if "scene" not in broken else ()),
        *(_robot(config) if "robot" not in broken else ()),
    ]
    if "clock" not in broken:
        found += [*_clock(config), *_rates(config), *_polling(config), *schedule_mistakes(config)]
    return found


def _board(name: str, board: BoardConfig, known: list[str]) -> Iterator[Mistake]:
    place = f"board.{name}"
    if not BOARD_NAME.fullmatch(name) or name in RESERVED:
        yield Mistake(place, None, f"invalid name for a board; {PERMITTED}")
    others = ", ".join(other for other in known if other != name) or "none"
    for key, neighbours in (("above", board.above), ("below", board.below)):
        for other in neighbours:
            if other == name or other not in known:
                yield Mistake(f"{place}.{key}", other, f"no other board has this name; boards: {others}")
        yield from _repeated(f"{place}.{key}", neighbours)
    yield from _planner(place, board)


def _host(name: str, host: HostConfig, boards: list[str]) -> Iterator[Mistake]:
    place = f"host.{name}"
    if not BOARD_NAME.fullmatch(name) or name in RESERVED:
        yield Mistake(place, None, f"invalid name for a board; {PERMITTED}")
    if name in boards:
        yield Mistake(place, None, f"board.{name} has this name already")
    for other in host.below:
        if other not in boards:
            yield Mistake(f"{place}.below", other, f"no board has this name; boards: {', '.join(boards)}")
    yield from _repeated(f"{place}.below", host.below)


def _circles(config: RackConfig) -> Iterator[Mistake]:
    """Find a circle among levels: a walk from level to level would not end."""
    links = list(config.links())
    try:
        TopologicalSorter({name: [upper for upper, lower in links if lower == name] for name in config.board}).prepare()
    except CycleError as error:
        circle = error.args[1][:-1]
        pairs = list(zip(circle, [*circle[1:], circle[0]], strict=True))
        # The link that only one of its boards names is the likely mistake.
        upper, lower = min(reversed(pairs), key=lambda link: len(_named_by(config, *link)))
        board, key, end = _named_by(config, upper, lower)[0]
        at = circle.index(lower)
        walk = " -> ".join([*circle[at:], *circle[:at], lower])
        why = f"the levels form a circle, {walk}; the {end} level has no {key}"
        yield Mistake(f"board.{board}.{key}", upper if board == lower else lower, why)


def _named_by(config: RackConfig, upper: str, lower: str) -> list[tuple[str, str, str]]:
    """Return board and key of every table that puts one board above another, and the end of a hierarchy without it."""
    tables = ((upper, "below", "lowest", lower), (lower, "above", "highest", upper))
    return [(board, key, end) for board, key, end, other in tables if other in getattr(config.board[board], key)]


def _planner(place: str, board: BoardConfig) -> Iterator[Mistake]:
    has_planner, is_loose = board.planner is not None, board.coupling == "loose"
    if has_planner != (board.coupling != "none"):
        permitted = '"tight" or "loose" with a planner' if has_planner else '"none" without a planner'
        yield Mistake(f"{place}.coupling", board.coupling, f"permitted: {permitted}")
    if is_loose and board.planner_slot is None:
        yield Mistake(f"{place}.planner_slot", None, "missing; a loosely coupled planner has its own board")
    for key in ("planner_slot", "planner_core"):
        if not is_loose and getattr(board, key) is not None:
            yield Mistake(f"{place}.{key}", getattr(board, key), 'only for a planner with coupling = "loose"')
    if board.coupling == "tight" and board.planner_priority >= max(board.priority, 1):
        why = f"must be below the executor's priority, {board.priority}, with a tightly coupled planner"
        yield Mistake(f"{place}.planner_priority", board.planner_priority, why)
    if not has_planner:
        # Otherwise such a time would be ignored silently.
        for table, keys in (("budget", PLANNER_BUDGET), ("transfer", PLANNER_TRANSFER)):
            for key in keys:
                if value := getattr(getattr(board, table), key, None):
                    yield Mistake(f"{place}.{table}.{key}", value, "the board has no planner; remove it, or add one")


def _slots(config: RackConfig) -> Iterator[Mistake]:
    taken: dict[int, str] = {}
    for name, board in config.board.items():
        for key, slot in (("slot", board.slot), ("planner_slot", board.planner_slot)):
            place = f"board.{name}.{key}"
            if slot is not None and slot in taken:
                yield Mistake(place, slot, f"already taken by {taken[slot]}")
            elif slot is not None:
                taken[slot] = place


def _ends(config: RackConfig) -> Iterator[Mistake]:
    ending = [name for name, board in config.board.items() if board.ends_run]
    for name in ending[1:]:
        yield Mistake(f"board.{name}.ends_run", True, f"only one board can end the run; '{ending[0]}' already does")


def _clock(config: RackConfig) -> Iterator[Mistake]:
    clock = config.clock
    if abs(clock.period_ms * 1e6 - config.clock_ns) > 1e-3:
        yield Mistake("clock.period_ms", clock.period_ms, "not a whole number of ns")
    if clock.mode == "lockstep" and clock.speed != 1.0:
        yield Mistake("clock.speed", clock.speed, 'lockstep runs as fast as it can; speed needs mode = "realtime"')
    tick_ms = clock.period_ms / clock.speed
    if tick_ms < SHORTEST_MS:
        why = f"a tick would take {tick_ms:g} ms of real time; permitted: {SHORTEST_MS:g} ms or more"
        yield Mistake("clock.speed", clock.speed, why)


def _rates(config: RackConfig) -> Iterator[Mistake]:
    for name, board in config.board.items():
        place = f"board.{name}.rate_hz"
        if (board.rate_hz is None) == (board.every is None):
            why = "missing; give rate_hz (Hz) or every (ticks)"
            yield Mistake(
                place,
                board.rate_hz,
                why if board.every is None else "every is also given; permitted: one of rate_hz, every",
            )
            continue
        try:
            every = config.every(name)
        except ClockError as error:
            yield Mistake(place, None, str(error))
        else:
            if every > LONGEST_EVERY:
                yield Mistake(
                    place, board.rate_hz, f"a cycle would take {every} ticks; permitted: up to {LONGEST_EVERY}"
                )
            if board.phase >= every:
                why = f"must be less than the board's period; permitted: 0 to {every - 1} ticks"
                yield Mistake(f"board.{name}.phase", board.phase, why)


def _polling(config: RackConfig) -> Iterator[Mistake]:
    """Refuse a board that busy-waits on a shared core: at a real-time priority it would starve the others."""
    cores = {CLOCK: config.clock.core} | {place.name: place.core for place in config.tasks()}
    for name, board in config.board.items():
        others = [other for other, core in cores.items() if core == board.core and other != name]
        if (board.wake or config.clock.wake) == "poll" and others:
            why = f"needs a core of its own, but shares core {board.core} with: {', '.join(others)}"
            yield Mistake(f"board.{name}.wake", "poll", why)


def _robot(config: RackConfig) -> Iterator[Mistake]:
    robot = config.robot
    if robot is None:
        return
    joints = len(robot.joints)
    if file_at(robot.model) is None:
        yield Mistake("robot.model", str(robot.model), "no such file")
    for key in ("home", "velocity", "acceleration", "jerk", "torque", "position"):
        values = getattr(robot, key)
        if values is not None and len(values) != joints:
            yield Mistake(f"robot.{key}", list(values), f"{len(values)} values; permitted: {joints}, one per joint")
    for key, values in robot.sensors:
        if isinstance(values, tuple) and len(values) != joints:
            why = f"{len(values)} values; permitted: one for all joints, or {joints}, one per joint"
            yield Mistake(f"robot.sensors.{key}", list(values), why)
    yield from _repeated("robot.joints", robot.joints)


def _scene(config: RackConfig) -> Iterator[Mistake]:
    scene = config.scene
    for kind, key, those in (
        ("motion", "body", "obstacles"),
        ("push", "body", "objects"),
        ("goal", "object", "objects"),
    ):
        for at, entry in enumerate(getattr(scene, kind)):
            name, known = getattr(entry, key), getattr(scene, those)
            if name not in known:
                why = f"no such {those[:-1]}; scene.{those}: {', '.join(known) or 'none'}"
                yield Mistake(f"scene.{kind}[{at}].{key}", name, why)
    yield from _repeated("scene.objects and scene.obstacles", scene.bodies)


def _repeated(place: str, names: tuple[str, ...]) -> Iterator[Mistake]:
    for name, count in Counter(names).items():
        if count > 1:
            yield Mistake(place, name, f"listed {count} times")
