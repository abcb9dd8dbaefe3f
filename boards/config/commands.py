"""Operator commands: made into requests for the operator table, once their rules are kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.layout import Layout
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.backplane.operator_table import Request
from rack.boards.config.mistakes import mistakes_of
from rack.boards.config.rules.commands import command_mistakes
from rack.boards.config.schema import CommandConfig, RackConfig
from rack.boards.config.timing import first_tick
from rack.boards.config.wiring import commandable, executor_of
from rack.boards.errors import ConfigError
from rack.levels.algebra import norm
from rack.levels.errors import LevelError
from rack.levels.operator import NAMED, Commands, Goal, Operation, goal_names
from rack.levels.tables import live_keys, read_params

DOWN = (0.0, 0.0, -1.0)


def takes(config: RackConfig, board: str, commands: Commands) -> str:
    """Return the commands that a level takes as text, with the names that it knows: "hold, resume,
    table saw|slow"."""
    executor = executor_of(config, board)
    words = []
    for what, goals in commands.items():
        names: Sequence[str] = ()
        if what is Operation.SET:
            names = live_keys(executor.params)
        elif what in NAMED:
            # A table may be in the middle of being edited.
            with suppress(LevelError):
                names = executor.wording(what, config.board[board].params, config.scene)
        wording = (what.name.lower(), "|".join(names), goal_names(goals))
        words.append(" ".join(word for word in wording if word))
    return ", ".join(words)


def live_params(config: RackConfig) -> dict[str, Sequence[str]]:
    """Return the params that an operator may set live, by board; boards without any are omitted."""
    return {
        name: live_keys(executor_of(config, name).params)
        for name, commands in commandable(config).items()
        if Operation.SET in commands
    }


def launched_with(config: RackConfig, board: str, key: str) -> Any:
    """Return a parameter of a board as it was launched; None: there is no such."""
    kind = executor_of(config, board).params
    if kind is None:
        return None
    return getattr(read_params(kind, config.board[board].params), key, None)


def setting_name(config: RackConfig, board: str, number: int) -> str:
    """Return the name that a board's level gives to something by `number`: see `Executor.names`."""
    return executor_of(config, board).names(config.board[board].params)[number]


def asked(given: Mapping[str, Any]) -> CommandConfig:
    """Return the command in a mapping, as in a `[[command]]` table. Raises `ConfigError` with every
    mistake."""
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
    spec = layout.mailbox(name)
    message = Message(message_dtype(spec.fields, spec.size))
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
