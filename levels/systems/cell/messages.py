"""Orders for a task level from another rack, and its reports: one mailbox each way for every arm.

Both racks must have the same layout of them, whatever their arms: no symbolic sizes. Each message
says all there is to know, so that those that are lost, or overtaken by a newer one, are not missed.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, MessageType, command, status
from rack.levels.messages import OPERATED, Error
from rack.levels.operator import MAX_JOINTS, Goal

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
    Field(
        "position",
        "f8",
        "m",
        "where a transfer takes the object's origin, or a goto the tool",
        (3,),
    ),
    Field("turned", "u1", "1", "1: a transfer turns the object to `yaw`; 0: any turn"),
    Field("yaw", "f8", "rad", "turn of the object's x axis about the vertical"),
    Field("lift", "f8", "m", "height of a transfer's straight motions"),
    Field("quaternion", "f8", "1", "of the tool, for goal pose", (4,)),
    Field("direction", "f8", "1", "of the tool's z axis, for goal direction", (3,)),
    Field("count", "u1", "1", "joints that follow"),
    Field("joints", "f8", "rad", "joint positions, for goal joints", (MAX_JOINTS,)),
    Field("by", "f8", "s", "simulated time by which it must be done; 0: any time"),
)
"""An action; `by` is the time of the rack that wrote the message."""

CELL_ORDER = command(
    "cell_order",
    1,
    Field("program", "u4", "1", "checksum of the program that the order is of"),
    Field("what", "u1", OrderVerb, "ask, do, cancel: all of the order `id`; end"),
    Field("hold", "u1", "1", "1: the arm rests on its path while it does an order"),
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
    Field("program", "u4", "1", "as in the order that is echoed"),
    Field(
        "response",
        "u1",
        Response,
        "the answer to it; `reason`: of a refusal or failure, else of waiting",
    ),
    Field(
        "earliest",
        "f8",
        "s",
        "earliest end, simulated time of the rack that gave the order; 0: not known",
    ),
    Field(
        "until",
        "f8",
        "s",
        "in that time, when DO must be read for an answer POSSIBLE to hold; 0: any time",
    ),
    Field("moves_done", "u2", "1", "elemental moves of the order done"),
    Field("moves", "u2", "1", "elemental moves of the order; 0 before it begins"),
    Field(
        "halted",
        "u1",
        "1",
        "1: moves were withdrawn, the arm is held until it begins another order",
    ),
    OPERATED,
    errors=Error,
)

CELL_REQUEST = MessageType(
    "cell_request",
    1,
    (
        Field("id", "u4", "1", "serial of the plan wanted; 0: none yet"),
        Field("program", "u4", "1", "as in the order that it serves"),
        Field("order", "u4", "1", "that order"),
        Field(
            "begin", "f8", "s", "simulated time at which it must be possible to begin; 0: at once"
        ),
        Field(
            "ahead",
            "f8",
            "s",
            "simulated time of the rack that gave the order, in which `by` is, less that here",
        ),
        Field("revision", "u4", "1", "of the world model then"),
        Field("start", "f8", "rad", "where the arm rested then", ("joints",)),
        *ACTION_FIELDS,
    ),
)
"""From an ordered task level's executor to its planner."""

CELL_PROGRESS = MessageType(
    "cell_progress",
    1,
    (
        Field("phase", "u1", Phase, "of the present step"),
        Field("step", "u2", "1", "steps done"),
        Field("attempt", "u2", "1", "times that the present step was asked for before"),
        Field("error", "u2", Error, "why the program ends early; 0: it does not"),
        Field("reason", "S120", "ASCII", "the error, readable"),
        Field("ending", "f8", "s", "simulated time since when the arms are ended; 0: not yet"),
        Field("moves", "u2", "1", "elemental moves of the steps done"),
    ),
)
"""A coordinator's memory, from which it continues after a restart of its board."""
