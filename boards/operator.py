"""Operator requests: the addressed level, the message, and the command as text."""

from __future__ import annotations

import numpy as np

from rack.backplane.checked import as_named, pick
from rack.backplane.errors import DamageError
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.operator_table import RequestEntry
from rack.levels.operator import Goal, Operation, OperatorCommand


def level_of(entry: RequestEntry, layout: Layout) -> str:
    """Return the board whose level a request addresses."""
    return _mailbox(entry, layout).name.partition(".")[0]


def message_of(entry: RequestEntry, layout: Layout) -> OperatorCommand:
    """Return a copy of a request's message."""
    spec = _mailbox(entry, layout)
    message = OperatorCommand(message_dtype(spec.fields, spec.size))
    message.raw[:] = entry.message[: spec.size]
    return message


def _mailbox(entry: RequestEntry, layout: Layout) -> MailboxSpec:
    """Return the mailbox of a request.

    Raises:
        DamageError: The mailbox is not an operator's.
    """
    mailbox = pick(layout.mailboxes, entry.mailbox, "mailbox")
    if mailbox.message != OperatorCommand.message_type.name:
        raise DamageError(f"mailbox '{mailbox.name}' does not take operators' commands")
    return mailbox


def hold(mailbox: MailboxSpec) -> OperatorCommand:
    """Build the operator's hold command for the operator mailbox of a level."""
    message = OperatorCommand(message_dtype(mailbox.fields, mailbox.size))
    message.what = Operation.HOLD
    return message


def describe(message: OperatorCommand) -> str:
    """Describe a command in one line: its verb, the name in it, and its goal."""
    verb = as_named(Operation, message.what).name.lower()
    goal = message.goal
    if goal == Goal.JOINTS:
        return f"{verb} joints {_numbers(message.joints[: message.count])}"
    if goal == Goal.POSE:
        return (
            f"{verb} position {_numbers(message.position)} quaternion"
            f" {_numbers(message.quaternion)}"
        )
    if goal == Goal.DIRECTION:
        return (
            f"{verb} position {_numbers(message.position)} direction {_numbers(message.direction)}"
        )
    name = f" {message.name}" if message.name else ""
    kind = f" {as_named(Goal, goal).name.lower()}" if goal else ""
    return f"{verb}{name}{kind}"


def _numbers(values: np.ndarray) -> str:
    """Format numbers for a command line."""
    return ", ".join(f"{value:g}" for value in values.tolist())
