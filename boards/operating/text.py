"""An operator's command in words, and as an event."""

from __future__ import annotations

import time

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.message import Message
from rack.backplane.operator_table import RequestEntry, RequestWord
from rack.backplane.slots import message_dtype
from rack.boards.events import Event
from rack.levels.operator import Goal, Operation


def level_of(entry: RequestEntry, layout: Layout) -> str:
    """Return the board whose level a request is for."""
    return layout.mailboxes[entry[RequestWord.MAILBOX]].name.partition(".")[0]


def message_of(entry: RequestEntry, layout: Layout) -> Message:
    """Return a copy of the message of a request, an `OPERATOR_COMMAND`."""
    spec = layout.mailboxes[entry[RequestWord.MAILBOX]]
    message = Message(message_dtype(spec.fields, spec.size))
    message.raw[:] = entry.message[: spec.size]
    return message


def describe(message: Message) -> str:
    """Return a command as one line: what, and its goal."""
    what, goal = Operation(message.what).name.lower(), message.goal
    if goal == Goal.JOINTS:
        return f"{what} joints {_numbers(message.joints[: message.count])}"
    if goal == Goal.POSE:
        return f"{what} position {_numbers(message.position)} quaternion {_numbers(message.quaternion)}"
    if goal == Goal.DIRECTION:
        return f"{what} position {_numbers(message.position)} direction {_numbers(message.direction)}"
    return f"{what} home" if goal == Goal.HOME else what


def command_event(row: np.void, entry: RequestEntry, layout: Layout) -> Event:
    """Return the event that the giving of a command makes; `row` is of `rack.backplane.alarms.RECORD`."""
    level, message, serial = level_of(entry, layout), message_of(entry, layout), int(row["value"])
    text = f"{describe(message)} (command {serial})"
    realtime_ns = int(row["time_ns"]) + time.time_ns() - time.monotonic_ns()
    code = Operation(message.what).name.lower()
    return Event(realtime_ns, int(row["tick"]), "command", level, text, code, subject=level, value=serial)


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values.tolist())
