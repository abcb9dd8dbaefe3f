"""An operator's command: its `[[command]]` table, and the message that carries it, in words."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from rack.backplane.layout import Layout
from rack.backplane.message import Message
from rack.backplane.operator_table import RequestEntry, RequestWord
from rack.backplane.slots import message_dtype
from rack.levels.operator import Goal, Operation
from rack.levels.tables import LAST_TICK, Finite, Table

Vector = tuple[Finite, Finite, Finite]


class CommandConfig(Table):
    """`[[command]]`: one command of an operator to one level."""

    level: str = Field(description="board whose level is commanded, such as servo or task")
    what: Literal["hold", "resume", "setpoint", "goto"] = Field(
        description="hold: come to rest; resume: continue; setpoint, goto: move to a goal and stay there"
    )
    tick: int | None = Field(
        None, ge=0, le=LAST_TICK, description="tick at which it is given; at most one of tick and at"
    )
    at: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)] | None = Field(
        None, description="instead of tick: simulated time, s"
    )
    joints: tuple[Finite, ...] | None = Field(None, description="goal: one position per joint, rad")
    position: Vector | None = Field(None, description="goal: tool position, m; with quaternion or direction")
    quaternion: tuple[Finite, Finite, Finite, Finite] | None = Field(
        None, description="goal: tool orientation as w, x, y, z"
    )
    direction: Vector | None = Field(
        None, description="goal: direction of the tool's z axis, free to turn about it; default: down"
    )
    home: bool = Field(False, description="goal: the arm's start position")

    @property
    def said(self) -> Operation:
        """The command's verb."""
        return Operation[self.what.upper()]

    @property
    def goals(self) -> list[Goal]:
        """The goals given: there must be one, or none."""
        found = [Goal.JOINTS] if self.joints is not None else []
        if self.position is not None or self.quaternion is not None or self.direction is not None:
            found.append(Goal.DIRECTION if self.quaternion is None else Goal.POSE)
        return [*found, Goal.HOME] if self.home else found


def level_of(entry: RequestEntry, layout: Layout) -> str:
    """Return the board whose level a request is for."""
    return layout.mailboxes[entry[RequestWord.MAILBOX]].name.partition(".")[0]


def message_of(entry: RequestEntry, layout: Layout) -> Message:
    """Return a copy of a request's message, an `OPERATOR_COMMAND`."""
    spec = layout.mailboxes[entry[RequestWord.MAILBOX]]
    message = Message(message_dtype(spec.fields, spec.size))
    message.raw[:] = entry.message[: spec.size]
    return message


def describe(message: Message) -> str:
    """Return a command as one line: its verb and its goal."""
    what, goal = Operation(message.what).name.lower(), message.goal
    if goal == Goal.JOINTS:
        return f"{what} joints {_numbers(message.joints[: message.count])}"
    if goal == Goal.POSE:
        return f"{what} position {_numbers(message.position)} quaternion {_numbers(message.quaternion)}"
    if goal == Goal.DIRECTION:
        return f"{what} position {_numbers(message.position)} direction {_numbers(message.direction)}"
    return f"{what} home" if goal == Goal.HOME else what


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values.tolist())
