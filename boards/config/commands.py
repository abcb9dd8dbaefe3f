"""Operator commands: made into requests for the operator table, once their rules are kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.operator_table import Request
from rack.boards.config.mistakes import mistakes_of
from rack.boards.config.published import Levels, PublishedLevel
from rack.boards.config.rules.commands import command_mistakes
from rack.boards.config.schema import CommandConfig, RackConfig
from rack.boards.config.timing import first_tick
from rack.boards.errors import ConfigError
from rack.levels.algebra import norm
from rack.levels.operator import Goal, OperatorCommand, goal_names

DOWN = (0.0, 0.0, -1.0)


def takes(level: PublishedLevel) -> str:
    """Return the commands that a level takes as text, with the names that it knows: "hold, resume,
    table saw|slow"."""
    words = []
    for what, goals in level.commands.items():
        names = "|".join(level.wording.get(what, ()))
        wording = (what.name.lower(), names, goal_names(goals))
        words.append(" ".join(word for word in wording if word))
    return ", ".join(words)


def asked(given: Mapping[str, Any]) -> CommandConfig:
    """Return the command in a mapping, as in a `[[command]]` table. Raises `ConfigError` with every
    mistake."""
    try:
        return CommandConfig.model_validate(given)
    except ValidationError as error:
        raise ConfigError(mistakes_of(error, CommandConfig, given)) from None


def request(command: CommandConfig, config: RackConfig, levels: Levels, layout: Layout) -> Request:
    """Return the request of one command. Raises `ConfigError` with every mistake."""
    if mistakes := command_mistakes([("", command)], config, levels):
        raise ConfigError(mistakes)
    return _request(command, layout)


def requests(config: RackConfig, layout: Layout) -> tuple[Request, ...]:
    """Return the requests of a config whose commands have been checked."""
    return tuple(_request(command, layout) for command in config.command)


def _request(command: CommandConfig, layout: Layout) -> Request:
    name = f"{command.level}.operator"
    spec = layout.mailbox(name)
    message = OperatorCommand(message_dtype(spec.fields, spec.size))
    message.what = command.said
    message.goal = (command.goals or [Goal.NONE])[0]
    if command.joints is not None:
        message.count = len(command.joints)
        message.joints[: message.count] = command.joints
    if command.position is not None:
        message.position[:] = command.position
        message.direction[:] = command.direction or DOWN
    if command.quaternion is not None:
        message.quaternion[:] = np.array(command.quaternion) / norm(command.quaternion)
    message.name = command.name or ""
    return Request(layout.index(name), bytes(message.raw), first_tick(command, layout.clock_ns))
