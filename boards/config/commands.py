"""Operator commands: checked against their rack, and made into requests for the operator table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.backplane.operator_table import Request
from rack.boards.classes import find_class
from rack.boards.config.cell import joint_ranges
from rack.boards.config.mistakes import mistakes_of
from rack.boards.config.schema import CommandConfig, RackConfig
from rack.boards.errors import ConfigError, Mistake
from rack.levels.algebra import norm
from rack.levels.errors import LevelError, RobotError
from rack.levels.level import Executor
from rack.levels.operator import NAMED, Commands, Goal, goal_names, listed

OWN_OPERATOR = "own.operator"
DOWN = (0.0, 0.0, -1.0)


def commandable(config: RackConfig) -> dict[str, Commands]:
    """Return the commands that each level takes from an operator, by board; levels that take none are omitted."""
    found = {}
    for name, board in config.board.items():
        try:
            executor = find_class(board.executor, Executor)
        except LookupError:
            continue  # reported elsewhere
        if any(port.source == OWN_OPERATOR for port in executor.inputs.values()):
            found[name] = executor.commands
    return found


def takes(config: RackConfig, board: str, commands: Commands) -> str:
    """Return the commands that a level takes as text, with the names that it knows: "hold, resume, table saw|slow"."""
    table = config.board[board]
    executor = find_class(table.executor, Executor)
    words = []
    for what, goals in commands.items():
        names = ""
        # A table may be in the middle of being edited.
        with suppress(LevelError):
            names = "|".join(executor.wording(what, table.params, config.scene)) if what in NAMED else ""
        words.append(" ".join(word for word in (what.name.lower(), names, goal_names(goals)) if word))
    return ", ".join(words)


def setting_name(config: RackConfig, board: str, number: int) -> str:
    """Return the name that a board's level gives to something by `number`: see `Executor.names`."""
    return _names(board, config)[number]


def _names(board: str, config: RackConfig) -> Sequence[str]:
    table = config.board[board]
    return find_class(table.executor, Executor).names(table.params)


def asked(given: Mapping[str, Any]) -> CommandConfig:
    """Return the command in a mapping, as in a `[[command]]` table. Raises `ConfigError` with every mistake."""
    try:
        return CommandConfig.model_validate(given)
    except ValidationError as error:
        raise ConfigError(mistakes_of(error, CommandConfig, given)) from None


def request(command: CommandConfig, config: RackConfig, layout: Layout) -> Request:
    """Return the request of one command. Raises `ConfigError` with every mistake."""
    if mistakes := command_mistakes([("", command)], config):
        raise ConfigError(mistakes)
    return _request(command, layout)


def requests(config: RackConfig, layout: Layout) -> tuple[Request, ...]:
    """Return the requests of a config whose commands have been checked."""
    return tuple(_request(command, layout) for command in config.command)


def _request(command: CommandConfig, layout: Layout) -> Request:
    name = f"{command.level}.operator"
    index, spec = next((at, box) for at, box in enumerate(layout.mailboxes) if box.name == name)
    message = Message(message_dtype(spec.fields, spec.size))
    message.what, message.goal = command.said, (command.goals or [Goal.NONE])[0]
    if command.joints is not None:
        message.count = len(command.joints)
        message.joints[: message.count] = command.joints
    if command.position is not None:
        message.position[:] = command.position
        message.direction[:] = command.direction or DOWN
    if command.quaternion is not None:
        message.quaternion[:] = np.array(command.quaternion) / norm(command.quaternion)
    message.name = command.name or ""
    return Request(index, bytes(message.raw), _tick(command, layout.clock_ns))


def _tick(command: CommandConfig, clock_ns: int) -> int:
    if command.at is not None:
        return round(command.at * 1e9 / clock_ns)
    return -1 if command.tick is None else command.tick


def command_mistakes(
    commands: Iterable[tuple[str, CommandConfig]], config: RackConfig, broken: frozenset[str] = frozenset()
) -> list[Mistake]:
    """Return every mistake in commands, given with their places in a config; a live command has an empty place.

    Commands for `broken` boards, which have mistakes of their own, are not checked.
    """
    given = list(commands)
    checked = [(place, command) for place, command in given if command.level not in broken]
    found = [mistake for place, command in checked for mistake in _mistakes(place, command, config)]
    if len(given) > OPERATOR_ENTRIES:
        found.append(Mistake("command", len(given), f"too many pending commands; permitted: {OPERATOR_ENTRIES}"))
    return found


def _mistakes(place: str, command: CommandConfig, config: RackConfig) -> Iterator[Mistake]:
    def at(key: str) -> str:
        return f"{place}.{key}" if place else key

    if command.tick is not None and command.at is not None:
        yield Mistake(at("at"), command.at, "tick is also given; permitted: one of tick, at")
    levels = commandable(config)
    if command.level not in levels:
        why = f"no level of this name takes commands; levels that do: {', '.join(levels) or 'none'}"
        yield Mistake(at("level"), command.level, why)
        return
    known = levels[command.level]
    if command.said not in known:
        why = f"'{command.level}' does not take {command.what}; it takes: {listed(known)}"
        yield Mistake(at("what"), command.what, why)
        return
    yield from _goal(at, command, known)
    yield from _name(at("name"), command, config)
    if command.joints is not None and Goal.JOINTS in known[command.said]:
        yield from _joints(at("joints"), command.joints, config)
    for key in ("quaternion", "direction"):
        if getattr(command, key) is not None and not any(getattr(command, key)):
            yield Mistake(at(key), list(getattr(command, key)), "all zero; its length must not be zero")


def _goal(at: Callable[[str], str], command: CommandConfig, known: Commands) -> Iterator[Mistake]:
    """Check that there is one goal, of a form that the level accepts."""
    wanted, given = known[command.said], command.goals
    what = f"{command.what} of '{command.level}'"
    if not wanted:
        for goal in given:
            yield Mistake(at(_key(goal)), None, f"{command.what} takes no goal; remove it")
    elif len(given) != 1:
        why = "missing" if not given else f"several given: {goal_names(given)}"
        yield Mistake(at("goal"), None, f"{why}; {what} takes one of: {goal_names(wanted)}")
    elif given[0] not in wanted:
        yield Mistake(at(_key(given[0])), None, f"not a goal for {what}; permitted: {goal_names(wanted)}")
    elif command.position is None and given[0] in (Goal.POSE, Goal.DIRECTION):
        yield Mistake(at("position"), None, "missing; tool position, m")
    elif command.quaternion is not None and command.direction is not None:
        why = "quaternion is also given; permitted: one of quaternion, direction"
        yield Mistake(at("direction"), list(command.direction), why)


def _key(goal: Goal) -> str:
    keys = {Goal.POSE: "quaternion", Goal.DIRECTION: "position", Goal.OFF: "on"}
    return keys.get(goal, goal.name.lower())


def _name(place: str, command: CommandConfig, config: RackConfig) -> Iterator[Mistake]:
    """Check that an operation that gives a name, and no other, gives one that its level knows."""
    if command.said not in NAMED:
        if command.name is not None:
            yield Mistake(place, command.name, f"{command.what} takes no name; remove it")
        return
    board = config.board[command.level]
    try:
        known = find_class(board.executor, Executor).wording(command.said, board.params, config.scene)
    except LevelError:
        return  # reported elsewhere
    if command.name not in known:
        yield Mistake(place, command.name, f"{command.what} of '{command.level}' knows: {', '.join(known) or 'none'}")


def _joints(place: str, joints: tuple[float, ...], config: RackConfig) -> Iterator[Mistake]:
    robot = config.robot
    if robot is None:
        yield Mistake(place, list(joints), "the rack has no arm")
        return
    if len(joints) != len(robot.joints):
        why = f"{len(joints)} values; permitted: {len(robot.joints)}, one per joint: {', '.join(robot.joints)}"
        yield Mistake(place, list(joints), why)
        return
    try:
        ranges = joint_ranges(robot, config.scene, config.clock_ns)
    except RobotError:
        return  # reported elsewhere
    for name, value, (low, high) in zip(robot.joints, joints, ranges, strict=True):
        if not low <= value <= high:
            yield Mistake(place, value, f"out of range for joint '{name}'; permitted: {low:g} to {high:g} rad")
