"""Operator commands of a config: checks, and requests for the operator table."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.operator_table import Request
from rack.backplane.words import Scheduler
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.command import CommandConfig
from rack.boards.config.connections import find_executors
from rack.boards.config.mistakes import convert_errors, format_place
from rack.boards.config.published import Levels, PublishedLevel
from rack.boards.config.schedulers import list_reservation_mistakes, list_valid_schedulers
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import compute_first_tick
from rack.boards.errors import ConfigError, Mistake, Mistakes
from rack.levels.errors import LevelError, RobotError
from rack.levels.operator import (
    NAMED_OPERATIONS,
    Commands,
    Goal,
    Operation,
    OperatorCommand,
    format_commands,
    format_goals,
)
from rack.levels.tables import read_setting

DOWN = (0.0, 0.0, -1.0)


def describe_commands(level: PublishedLevel) -> str:
    """Return a level's commands, with valid names and goals, as in "hold, table saw|slow"."""
    words = []
    for what, goals in level.commands.items():
        names = "|".join(level.wording.get(what, ()))
        wording = (what.name.lower(), names, format_goals(goals))
        words.append(" ".join(filter(None, wording)))
    return ", ".join(words)


def parse_command(table: Mapping[str, Any]) -> CommandConfig:
    """Return the command that a `[[command]]` table describes.

    Raises:
        ConfigError: The table has mistakes. All of them are listed.
    """
    try:
        return CommandConfig.model_validate(table)
    except ValidationError as error:
        raise ConfigError(convert_errors(error, CommandConfig, table)) from None


def build_request(
    command: CommandConfig, config: RackConfig, levels: Levels, layout: Layout
) -> Request:
    """Check a live command and return its request for the operator table.

    Args:
        command: The command.
        config: Config of the running rack.
        levels: Levels that the rack has published.
        layout: Layout of its segment.

    Raises:
        ConfigError: The command has mistakes. All of them are listed.
    """
    if mistakes := find_command_mistakes([("", command)], config, levels):
        raise ConfigError(mistakes)
    return _encode_request(command, layout)


def build_requests(config: RackConfig, layout: Layout) -> tuple[Request, ...]:
    """Return the operator table's requests for the commands of a checked config."""
    return tuple(_encode_request(command, layout) for command in config.command)


def _encode_request(command: CommandConfig, layout: Layout) -> Request:
    """Convert a checked command to a request for the operator table."""
    name = f"{command.level}.operator"
    spec = layout.find_mailbox(name)
    message = OperatorCommand(build_message_dtype(spec.fields, spec.size))
    message.what = command.operation
    message.goal = (command.goals or [Goal.NONE])[0]
    if command.joints is not None:
        message.count = len(command.joints)
        message.joints[: message.count] = command.joints
    if command.position is not None:
        message.position[:] = command.position
        message.direction[:] = command.direction or DOWN
    if command.quaternion is not None:
        # Import MuJoCo only for goals with an orientation.
        from rack.levels.algebra import norm

        message.quaternion[:] = np.array(command.quaternion) / norm(command.quaternion)
    message.name = command.name or ""
    return Request(
        layout.find_mailbox_index(name),
        bytes(message.raw),
        compute_first_tick(command, layout),
    )


def find_command_mistakes(
    commands: Iterable[tuple[str, CommandConfig]],
    config: RackConfig,
    levels: Levels,
    broken: Collection[str] = (),
) -> list[Mistake]:
    """Return every mistake in operator commands.

    Args:
        commands: Pairs of a command's place in the config, as in "command[0]", and the command. The
            place of a live command is "".
        config: The config of the rack.
        levels: Its levels.
        broken: Boards with known mistakes. Commands for them are not checked.
    """
    placed = list(commands)
    mistakes = [
        mistake
        for place, command in placed
        if command.level not in broken
        for mistake in _check_command(place, command, config, levels)
    ]
    if len(placed) > OPERATOR_ENTRIES:
        mistakes.append(
            Mistake(
                "command",
                len(placed),
                f"too many commands; at most {OPERATOR_ENTRIES} may be pending",
            )
        )
    return mistakes


def _check_command(
    place: str, command: CommandConfig, config: RackConfig, published: Levels
) -> Mistakes:
    """Yield every mistake in one operator command. `place` is "" for a live command."""
    at = partial(format_place, place)
    if command.tick is not None and command.at is not None:
        yield Mistake(at("at"), command.at, "tick is also given; give only one of tick, at")
    levels = {name: level for name, level in published.items() if level.commands}
    if command.level not in levels:
        why = f"no level of this name takes commands; levels that do: {', '.join(levels) or 'none'}"
        yield Mistake(at("level"), command.level, why)
        return
    level = levels[command.level]
    known = level.commands
    if command.operation not in known:
        why = f"'{command.level}' does not take {command.what}; it takes: {format_commands(known)}"
        yield Mistake(at("what"), command.what, why)
        return
    yield from _check_goal(at, command, known)
    if command.operation is Operation.SET:
        yield from _check_setting(place, command, level, config)
    elif command.operation is Operation.SCHEDULE:
        yield from _check_scheduler(at("name"), command, config)
    else:
        yield from _check_name(at("name"), command, level)
    if command.joints is not None and Goal.JOINTS in known[command.operation]:
        yield from _check_joints(at("joints"), command.joints, config)
    for key in ("quaternion", "direction"):
        value = getattr(command, key)
        if value is not None and not any(value):
            yield Mistake(at(key), list(value), "all zero; its length must not be zero")


def _check_goal(at: Callable[[str], str], command: CommandConfig, known: Commands) -> Mistakes:
    """Check that a command has one goal of an accepted form, or no goal if it does not take any.

    Args:
        at: Function that returns the place in the config of a key of the command.
        command: The command.
        known: Commands that the level takes, with the accepted forms of their goals.
    """
    accepted = known[command.operation]
    goals = command.goals
    what = f"{command.what} of '{command.level}'"
    if not accepted:
        for goal in goals:
            yield Mistake(
                at(_find_goal_key(goal)), None, f"{command.what} takes no goal; remove it"
            )
    elif len(goals) != 1:
        why = "missing" if not goals else f"several given: {format_goals(goals)}"
        yield Mistake(at("goal"), None, f"{why}; {what} takes one of: {format_goals(accepted)}")
    elif goals[0] not in accepted:
        yield Mistake(
            at(_find_goal_key(goals[0])),
            None,
            f"not a goal for {what}; valid goals: {format_goals(accepted)}",
        )
    elif command.position is None and goals[0] in (Goal.POSE, Goal.DIRECTION):
        yield Mistake(at("position"), None, "missing; tool position, m")
    elif command.quaternion is not None and command.direction is not None:
        why = "quaternion is also given; give only one of quaternion, direction"
        yield Mistake(at("direction"), list(command.direction), why)


def _find_goal_key(goal: Goal) -> str:
    """Return the key of a `[[command]]` table that specifies a goal of this form."""
    keys = {Goal.POSE: "quaternion", Goal.DIRECTION: "position", Goal.OFF: "on"}
    return keys.get(goal, goal.name.lower())


def _check_name(place: str, command: CommandConfig, level: PublishedLevel) -> Mistakes:
    """Check that a command has a name that its level knows, or no name if it does not take any."""
    if command.operation not in NAMED_OPERATIONS:
        if command.name is not None:
            yield Mistake(place, command.name, f"{command.what} takes no name; remove it")
        return
    known = level.wording.get(command.operation)
    # The names are unknown if the level's table has mistakes, which are reported separately.
    if known is not None and command.name not in known:
        yield Mistake(
            place,
            command.name,
            f"{command.what} of '{command.level}' knows: {', '.join(known) or 'none'}",
        )


def _check_setting(
    place: str, command: CommandConfig, level: PublishedLevel, config: RackConfig
) -> Mistakes:
    """Check that a command `set` names a live parameter of its level.

    The value is checked only in a config, because the level's class is needed for it. A running
    level checks the value of a live command itself.
    """
    name = format_place(place, "name")
    try:
        key, value = read_setting(command.name or "")
    except LevelError as error:
        yield Mistake(name, command.name, str(error))
        return
    if key not in level.live_keys:
        params = name if place else f"board.{command.level}.params"
        why = f"not a live parameter; live parameters: {', '.join(level.live_keys) or 'none'}"
        yield Mistake(f"{params}.{key}", value, why)
    elif place and (kind := find_executors(config)[command.level].params) is not None:
        table = {**config.board[command.level].params, key: value}
        try:
            kind.model_validate(table)
        except ValidationError as error:
            yield from convert_errors(error, kind, table, name)


def _check_scheduler(place: str, command: CommandConfig, config: RackConfig) -> Mistakes:
    """Check that a command `schedule` names a scheduler that the board can have."""
    valid = list_valid_schedulers(config)
    if command.name not in valid:
        why = f"no scheduler in this clock mode; valid: {', '.join(valid)}"
        yield Mistake(place, command.name, why)
    elif command.name == Scheduler.EARLIEST_DEADLINE_FIRST.word:
        yield from list_reservation_mistakes(config, command.level, place)


def _check_joints(place: str, joints: tuple[float, ...], config: RackConfig) -> Mistakes:
    """Check that a joint goal has one value per joint, within the joint's position limits."""
    robot = config.robot
    if robot is None:
        yield Mistake(place, list(joints), "the rack has no arm")
        return
    if (count := len(robot.joints)) != len(joints):
        why = f"{len(joints)} values; must be {count}, one per joint: {', '.join(robot.joints)}"
        yield Mistake(place, list(joints), why)
        return
    try:
        ranges = build_rack_cell(config).limits.position
    except RobotError:
        # An arm that does not fit its model is reported by the rules for the robot.
        return
    for name, value, (low, high) in zip(robot.joints, joints, ranges, strict=True):
        if not low <= value <= high:
            why = f"out of range; joint '{name}' must be {low:g} to {high:g} rad"
            yield Mistake(place, value, why)
