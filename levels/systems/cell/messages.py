"""Orders for a task level from another rack, and its reports: one mailbox each way for every arm.

Both racks must have the same layout of them, whatever their arms: no symbolic sizes. Each message
says all there is to know, so that those that are lost, or overtaken by a newer one, are not missed.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

from pydantic import StringConstraints

from rack.backplane.message import Field, MessageType, command, status
from rack.levels.fields import by_joint, flag, number, real, short_count
from rack.levels.messages import OPERATED, Error
from rack.levels.operator import MAX_JOINTS, Goal

MailboxName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
OBJECT_BYTES = 32
"""Longest name of an object that an order can give."""


class OrderVerb(IntEnum):
    """What is said of an order."""

    NONE = 0
    ASK = 1  # rehearse the action, and answer whether it can be done by its time
    DO = 2  # carry out what was answered to be possible
    CANCEL = 3  # forget it, or come to rest where it can be broken off
    END = 4  # the program is over: come to rest, end the run


class OrderAction(IntEnum):
    """What an order is about, as in `[[task.action]]`."""

    NONE = 0
    TRANSFER = 1
    GOTO = 2
    HOME = 3


class Response(IntEnum):
    """An arm's answer to the order that its report echoes."""

    NONE = 0  # not yet
    POSSIBLE = 1  # kept until DO, CANCEL or another order
    REFUSED = 2
    DOING = 3
    DONE = 4
    FAILED = 5
    CANCELLED = 6  # before it began
    STOPPED = 7  # after it had begun, by CANCEL or another order
    ENDED = 8  # the arm rests, and its task level ends


class Phase(IntEnum):
    """What a coordinator is about."""

    AWAITING = 0  # the arms' reports, before the first step or after a new launch
    ASKING = 1
    DOING = 2
    CANCELLING = 3  # the answers, to ask anew
    ENDING = 4
    OVER = 5


ACTION_FIELDS = (
    Field("action", "u1", OrderAction, "what to do"),
    Field("object", f"S{OBJECT_BYTES}", "ASCII", "object of a transfer"),
    Field("goal", "u1", Goal, "form of a goto's goal: joints, pose or direction"),
    real("position", "m", "where a transfer takes the object's origin, or a goto the tool", 3),
    flag("turned", "1: a transfer turns the object to `yaw`; 0: any turn"),
    real("yaw", "rad", "turn of the object's x axis about the vertical"),
    real("lift", "m", "height of a transfer's straight motions"),
    real("quaternion", "1", "of the tool, for goal pose", 4),
    real("direction", "1", "of the tool's z axis, for goal direction", 3),
    flag("count", "joints that follow"),
    real("joints", "rad", "joint positions, for goal joints", MAX_JOINTS),
    real("by", "s", "simulated time by which it must be done; 0: any time"),
)
"""An action; `by` is the time of the rack that wrote the message."""

CELL_ORDER = command(
    "cell_order",
    1,
    number("program", "checksum of the program that the order is of"),
    Field("what", "u1", OrderVerb, "ask, do, cancel: all of the order `id`; end"),
    flag("hold", "1: the arm rests on its path while it does an order"),
    Field(
        "reason",
        "S120",
        "ASCII",
        "with `hold` why; with END why the program failed, empty: it is done",
    ),
    *ACTION_FIELDS,
)

CELL_REPORT = status(
    "cell_report",
    1,
    number("program", "as in the order that is echoed"),
    Field(
        "response",
        "u1",
        Response,
        "the answer to it; `reason`: of a refusal or failure, else of waiting",
    ),
    real(
        "earliest",
        "s",
        "earliest end, simulated time of the rack that gave the order; 0: not known",
    ),
    real(
        "until",
        "s",
        "in that time, when DO must be read for an answer POSSIBLE to hold; 0: any time",
    ),
    short_count("moves_done", "elemental moves of the order done"),
    short_count("moves", "elemental moves of the order; 0 before it begins"),
    flag("halted", "1: moves were withdrawn, the arm is held until it begins another order"),
    OPERATED,
    errors=Error,
)

CELL_REQUEST = MessageType(
    "cell_request",
    1,
    (
        number("id", "serial of the plan wanted; 0: none yet"),
        number("program", "as in the order that it serves"),
        number("order", "that order"),
        real("begin", "s", "simulated time at which it must be possible to begin; 0: at once"),
        real(
            "ahead",
            "s",
            "simulated time of the rack that gave the order, in which `by` is, less that here",
        ),
        number("revision", "of the world model then"),
        by_joint("start", "rad", "where the arm rested then"),
        *ACTION_FIELDS,
    ),
)
"""From an ordered task level's executor to its planner."""

CELL_PROGRESS = MessageType(
    "cell_progress",
    2,
    (
        Field("phase", "u1", Phase, "of the present step"),
        short_count("step", "steps done"),
        short_count("attempt", "times that the present step was asked for before"),
        Field("error", "u2", Error, "why the program ends early; 0: it does not"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        real("ending", "s", "simulated time since when the arms are ended; 0: not yet"),
        real("begun", "s", "simulated time from which `by` counts; 0: not yet"),
        short_count("moves", "elemental moves of the steps done"),
    ),
)
"""A coordinator's memory, from which it continues after a restart of its board."""
