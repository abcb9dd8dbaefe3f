"""Orders to a task level from another rack, and its reports: one mailbox each way for every arm.

Both racks must have the same message layout whatever their arms are, so there are no symbolic
sizes. Each message contains the complete state, so that messages may be lost or overtaken by newer
ones.
"""

from __future__ import annotations

from enum import IntEnum

from numpy import ndarray

from rack.backplane.message import Command, Message, Status, field, integer_field
from rack.levels.messages import OPERATED, Error, joint_field
from rack.levels.operator import MAX_JOINTS, Goal

OBJECT_BYTES = 32
"""Longest name of an object in an order."""


class OrderVerb(IntEnum):
    """Request of an order."""

    NONE = 0
    ASK = 1  # rehearse the action and answer whether it can be done in time
    DO = 2  # carry out the action that was answered to be possible
    CANCEL = 3  # forget the action, or come to rest where it can be interrupted
    END = 4  # the program is over: come to rest and end the run


class OrderAction(IntEnum):
    """Action of an order, as in `[[task.action]]`."""

    NONE = 0
    TRANSFER = 1
    GOTO = 2
    HOME = 3


class Response(IntEnum):
    """Answer of an arm to the order that its report echoes."""

    NONE = 0  # no answer yet
    POSSIBLE = 1  # valid until DO, CANCEL or another order
    REFUSED = 2
    DOING = 3
    DONE = 4
    FAILED = 5
    CANCELLED = 6  # cancelled before it began
    STOPPED = 7  # stopped by CANCEL or another order after it had begun
    ENDED = 8  # the arm rests and its task level ends


class Phase(IntEnum):
    """Activity of a coordinator."""

    AWAITING = 0  # waits for reports before the first step or after a new launch
    ASKING = 1
    DOING = 2
    CANCELLING = 3  # waits until all have cancelled, to ask again
    ENDING = 4
    OVER = 5


class CellAction(Message):
    """An action as in `[[task.action]]`. `by` is in the time of the rack that wrote the message."""

    action: OrderAction = field(doc="what to do")
    object: str = field(f"S{OBJECT_BYTES}", doc="object of a transfer")
    goal: Goal = field(doc="form of a goto's goal: joints, pose or direction")
    position: ndarray = field(
        unit="m", doc="where a transfer takes the object's origin, or a goto the tool", shape=3
    )
    turned: bool = field(doc="whether a transfer turns the object to `yaw`")
    yaw: float = field(unit="rad", doc="turn of the object's x axis about the vertical")
    lift: float = field(unit="m", doc="height of a transfer's straight motions")
    quaternion: ndarray = field(unit="1", doc="orientation of the tool, for goal pose", shape=4)
    direction: ndarray = field(
        unit="1", doc="direction of the tool's z axis, for goal direction", shape=3
    )
    count: int = integer_field("number of values in `joints`", "u1")
    joints: ndarray = field(unit="rad", doc="joint positions, for goal joints", shape=MAX_JOINTS)
    by: float = field(unit="s", doc="simulated time by which it must be done, 0 for any time")


class OrderHead(Command):
    """Head of an order, without its action."""

    program: int = integer_field("checksum of the program to which the order belongs")
    what: OrderVerb = field(doc="what to do with the order `id`, or the end of the program")
    hold: bool = field(doc="whether the arm must rest on its path while it carries out an order")
    reason: str = field(
        doc="reason for `hold`, or with END why the program failed, empty after success"
    )


class CellOrder(OrderHead, CellAction, version=1):
    """Order from a coordinator to the task level of another rack."""


class CellReport(Status, version=1):
    """Report of a task level to the rack that orders its actions."""

    error: Error = field("u2", doc="error code of the level, 0 if there is none")
    program: int = integer_field("checksum of the program of the echoed order")
    response: Response = field(
        doc="answer to the echoed order; `reason` says why it is refused, has failed or waits"
    )
    earliest: float = field(
        unit="s",
        doc="earliest end, simulated time of the rack that gave the order, 0 if it is not known",
    )
    until: float = field(
        unit="s",
        doc="latest time, on the same clock, to read DO after POSSIBLE, 0 for any time",
    )
    moves_done: int = integer_field("elemental moves of the order done", "u2")
    moves: int = integer_field("elemental moves of the order; 0 before it begins", "u2")
    halted: bool = field(
        doc="whether moves were withdrawn, so that the arm is held until it begins another order"
    )
    operated: bool = OPERATED


class RequestHead(Message):
    """Head of a request for a plan, without its action."""

    id: int = integer_field("serial of the plan wanted, 0 if there is none")
    program: int = integer_field("checksum of the program of the order")
    order: int = integer_field("id of the order")
    begin: float = field(
        unit="s", doc="simulated time at which it must be possible to begin, 0 for at once"
    )
    ahead: float = field(
        unit="s",
        doc="time of the rack that gave the order, to which `by` refers, minus the time here",
    )
    revision: int = integer_field("revision of the world model at the request")
    start: ndarray = joint_field("rad", "where the arm rested at the request")


class CellRequest(RequestHead, CellAction, version=1):
    """Request for a plan from an ordered task level's executor to its planner."""


class CellProgress(Message, version=2):
    """State of a coordinator, from which it continues after a restart of its board."""

    phase: Phase = field(doc="activity in the present step")
    step: int = integer_field("steps done", "u2")
    attempt: int = integer_field("number of earlier attempts at the present step", "u2")
    error: Error = field("u2", doc="why the program ends early, 0 if it does not")
    reason: str = field(doc="the error as text")
    ending: float = field(
        unit="s", doc="simulated time since when the arms are being ended, 0 before that"
    )
    begun: float = field(unit="s", doc="simulated time from which `by` counts, 0 before that")
    moves: int = integer_field("elemental moves of the steps done", "u2")
