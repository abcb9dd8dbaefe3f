"""The messages of force control.

A task frame has its origin at the tool, and the orientation that the command gives. Each of its six
axes, three of translation and three of rotation, is either an axis of motion or one of force.
Vectors of six are force, N, and torque, N m, or velocity, m/s, and angular velocity, rad/s. A
wrench is the force and torque that the surroundings exert on the tool.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from numpy import ndarray

from rack.backplane.message import Message, field, integer_field
from rack.levels.operator import AnsweringStatus, RelayedCommand
from rack.levels.systems.trajectory.messages import (
    MAX_HELD_REQUESTS,
    MotionRequest,
    MotionState,
    MotionStatus,
)

AXES = 6
"""Number of axes of a task frame: translations along x, y, z, then rotations about them."""


def per_axis(unit: str, doc: str, kind: str = "f8") -> Any:
    """Declare a message field with one number for each axis of a task frame.

    Args:
        unit: Unit of the numbers.
        doc: Meaning of the field.
        kind: Element type, as in numpy.
    """
    return field(kind, unit=unit, doc=doc, shape=AXES)


class Wrench(Message, version=1):
    """Sent by the board of an arm with a wrist sensor, in every cycle."""

    tick: int = field(unit="tick", doc="tick at which it was sensed")
    wrench: ndarray = per_axis(
        "N, N m", "of the contact, at the tool, in the world's frame, without weights"
    )
    sample: ndarray = per_axis("N, N m", "as the sensor gives it, in the sensor's frame")
    saturated: bool = field(doc="1: the sensor is at the end of its range")
    exceeded: int = integer_field("cycles in which the contact was beyond the arm's force limits")


class TaskContact(Message):
    """Wanted contact, by axis of the task frame."""

    frame: ndarray = field(
        unit="1", doc="orientation of the task frame in the world, w, x, y, z", shape=4
    )
    selected: ndarray = per_axis("1", "1 for an axis of force, 0 for an axis of motion", "u1")
    wrench: ndarray = per_axis(
        "N, N m", "wanted of the tool on the surroundings, on the axes of force"
    )
    speed: ndarray = per_axis(
        "m/s, rad/s", "most on the axes of force, both ways; 0 in a request: the level's default"
    )
    guard: ndarray = per_axis(
        "N, N m", "wrench in either direction that ends motion, or 0 if not guarded"
    )


class ComplianceHead(RelayedCommand):
    """State of a contact, without the wanted forces."""

    active: bool = field(doc="1 if any axis is an axis of force or guarded, else 0")


class Compliance(ComplianceHead, TaskContact, version=1):
    """Sent by the motion server to the level of hybrid control.

    `id` rises with every change. A guard takes effect once for each id.
    """


class ForceStatus(AnsweringStatus, version=1):
    """Sent by the level of hybrid control to the motion server."""

    sensed: int = field(unit="tick", doc="tick of the wrench, or -1 before the first one")
    wrench: ndarray = per_axis("N, N m", "of the contact, at the tool, in the task frame")
    wanted: ndarray = per_axis("N, N m", "on the axes of force; others 0")
    selected: ndarray = per_axis("1", "1: an axis of force", "u1")
    offset: ndarray = field(
        unit="m",
        doc="from where the motion alone would have the tool to where it is commanded",
        shape=3,
    )
    struck: int = integer_field("id of the newest command whose guard was struck, or 0")
    axis: int = integer_field("axis of that guard, or -1", "i2")


class ServerRequest(MotionRequest, TaskContact, version=1):
    """Sent by a client to a server of force and motion.

    It is a `MotionRequest`, or one of two more kinds:

    - COMPLY: later requests are carried out with these axes of force. It is done when the forces
      are as wanted. Without axes of force, it is done when the arm rests where compliance left it.
    - GUARD: the next of these wrenches ends the request under way with GUARDED, and the guard too.
      Requests after that one continue.

    Kind NONE with id 0 is a sign of life. Without one, or a request, the client counts as lost.
    """


class ServerState(MotionState, version=1):
    """State of a server, as in `MotionState`. The contact in force is in `Compliance`."""

    goal: ndarray = field(
        ServerRequest,
        doc="the request at whose goal the arm is, or to which it goes; id 0: none",
    )
    requests: ndarray = field(
        ServerRequest, doc="taken and not ended, oldest first", shape=MAX_HELD_REQUESTS
    )


class Mode(IntEnum):
    """Modes of a server of force and motion."""

    MOTION = 0
    FORCE = 1  # some axes are of force
    HELD = 2  # forces without a client, at rest on the axes of motion, for a bounded time
    RELEASING = 3  # that time is over, and the forces go to zero
    RELEASED = 4  # the arm holds its position; a CANCEL ends this, HELD and RELEASING


class ServerStatus(MotionStatus, version=1):
    """Requests of a server from acceptance to end, and the contact."""

    mode: Mode = field(doc="motion, force, or what is left of it without a client")
    place: ndarray = field(unit="m", doc="tool position as sensed", shape=3)
    quaternion: ndarray = field(unit="1", doc="tool orientation as sensed, w, x, y, z", shape=4)
    frame: ndarray = field(unit="1", doc="orientation of the task frame, w, x, y, z", shape=4)
    wrench: ndarray = per_axis("N, N m", "of the tool on the surroundings, in the task frame")
    wanted: ndarray = per_axis("N, N m", "the same as wanted, on the axes of force; others 0")
    selected: ndarray = per_axis("1", "1: an axis of force", "u1")
    guarded: int = integer_field("newest request that a guard has ended, or 0")
    axis: int = integer_field("axis of that guard, or -1", "i2")
