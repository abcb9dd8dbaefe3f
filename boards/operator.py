"""Reading of operator requests: the addressed level, the message, and the command as text."""

from __future__ import annotations

import numpy as np

from rack.backplane.checked import select_item, to_enum
from rack.backplane.errors import DamageError
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.operator_table import RequestEntry
from rack.levels.operator import Goal, Operation, OperatorCommand


def find_level(entry: RequestEntry, layout: Layout) -> str:
    """Return the name of the board whose level a request addresses."""
    return _find_mailbox(entry, layout).name.partition(".")[0]


def copy_request_message(entry: RequestEntry, layout: Layout) -> OperatorCommand:
    """Return a copy of a request's message."""
    spec = _find_mailbox(entry, layout)
    message = OperatorCommand(build_message_dtype(spec.fields, spec.size))
    message.raw[:] = entry.message[: spec.size]
    return message


def _find_mailbox(entry: RequestEntry, layout: Layout) -> MailboxSpec:
    """Return the mailbox to which a request's command is written.

    Raises:
        DamageError: The mailbox is not for operators' commands.
    """
    mailbox = select_item(layout.mailboxes, entry.mailbox, "mailbox")
    if mailbox.message != OperatorCommand.message_type.name:
        raise DamageError(f"mailbox '{mailbox.name}' does not take operators' commands")
    return mailbox


def build_hold_command(mailbox: MailboxSpec) -> OperatorCommand:
    """Build a hold command, to be written to the operator mailbox of a level."""
    message = OperatorCommand(build_message_dtype(mailbox.fields, mailbox.size))
    message.what = Operation.HOLD
    return message


def describe_command(message: OperatorCommand) -> str:
    """Describe a command in one line: its operation, and its goal or name if it has one."""
    verb = to_enum(Operation, message.what).name.lower()
    goal = message.goal
    if goal == Goal.JOINTS:
        return f"{verb} joints {_format_numbers(message.joints[: message.count])}"
    if goal == Goal.POSE:
        return (
            f"{verb} position {_format_numbers(message.position)} quaternion"
            f" {_format_numbers(message.quaternion)}"
        )
    if goal == Goal.DIRECTION:
        return (
            f"{verb} position {_format_numbers(message.position)} direction "
            f"{_format_numbers(message.direction)}"
        )
    name = f" {message.name}" if message.name else ""
    kind = f" {to_enum(Goal, goal).name.lower()}" if goal else ""
    return f"{verb}{name}{kind}"


def _format_numbers(values: np.ndarray) -> str:
    """Format numbers as text, separated by commas."""
    return ", ".join(f"{value:g}" for value in values.tolist())
