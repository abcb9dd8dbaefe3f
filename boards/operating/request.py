"""From a command as it is asked for to the request in the operator table that holds it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.backplane.operator_table import Request
from rack.boards.config.commands import command_mistakes, command_places
from rack.boards.config.schema import RackConfig
from rack.boards.config.schema_mistakes import mistakes_of
from rack.boards.errors import ConfigError
from rack.boards.operating.config import CommandConfig
from rack.levels.algebra import norm
from rack.levels.operator import Goal

DOWN = (0.0, 0.0, -1.0)


def asked(given: Mapping[str, Any]) -> CommandConfig:
    """Return the command that a mapping holds, as a `[[command]]` table. Raises `ConfigError` with every mistake."""
    try:
        return CommandConfig.model_validate(given)
    except ValidationError as error:
        raise ConfigError(mistakes_of(error, CommandConfig, given)) from None


def requests(config: RackConfig, layout: Layout) -> tuple[Request, ...]:
    """Return the commands of a config that has no mistakes."""
    return tuple(_request(command, layout) for _, command in command_places(config))


def request(command: CommandConfig, config: RackConfig, layout: Layout) -> Request:
    """Return one command. Raises `ConfigError` with every mistake."""
    mistakes = command_mistakes([("", command)], config)
    if mistakes:
        raise ConfigError(mistakes)
    return _request(command, layout)


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
    return Request(index, bytes(message.raw), _tick(command, layout.clock_ns))


def _tick(command: CommandConfig, clock_ns: int) -> int:
    if command.at is not None:
        return round(command.at * 1e9 / clock_ns)
    return -1 if command.tick is None else command.tick
