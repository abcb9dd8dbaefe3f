"""The messages of force control: what the wrist senses, what is wanted of a contact, and how the
contact is.

A task frame has its origin at the tool, and the orientation that the command gives. Of its six
axes, three of translation and three of rotation, each is either an axis of motion or one of force.
Vectors of six are force, N, and torque, N m, or velocity, m/s, and angular velocity, rad/s. A
wrench is what the surroundings exert on the tool.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from rack.backplane.message import Message, field
from rack.levels.operator import AnsweringStatus, RelayedCommand
from rack.levels.systems.trajectory.messages import HELD, MotionRequest, MotionState, MotionStatus

AXES = 6
"""Axes of a task frame: translations along x, y, z, then rotations about them."""


class Wrench(Message, version=1):
    """From the board of an arm with a wrist sensor, in every cycle."""

    tick: int = field(unit="tick", doc="tick at which it was sensed")
    wrench: np.ndarray = field(
        unit="N, N m",
        doc="of the contact, at the tool, in the world's frame, without weights",
        shape=AXES,
    )
    sample: np.ndarray = field(
        unit="N, N m", doc="as the sensor gives it, in the sensor's frame", shape=AXES
    )
    saturated: bool = field(doc="1: the sensor is at the end of its range")
    exceeded: int = field(
        "u4", unit="1", doc="cycles in which the contact was beyond the arm's force limits"
    )


class Compliance(RelayedCommand, version=1):
    """From the motion server to the level of hybrid control. `id` rises with every change; a guard
    strikes once an id."""

    active: bool = field(doc="1: some axis is one of force, or guarded; 0: motion alone")
    frame: np.ndarray = field(
        unit="1", doc="orientation of the task frame in the world, w, x, y, z", shape=4
    )
    selected: np.ndarray = field(
        "u1", unit="1", doc="1: an axis of force; 0: of motion", shape=AXES
    )
    wrench: np.ndarray = field(
        unit="N, N m",
        doc="wanted of the tool on the surroundings, on the axes of force",
        shape=AXES,
    )
    speed: np.ndarray = field(
        unit="m/s, rad/s", doc="most on the axes of force, both ways", shape=AXES
    )
    guard: np.ndarray = field(
        unit="N, N m",
        doc="wrench, either way, at which motion ends; 0: the axis is not guarded",
        shape=AXES,
    )


class ForceStatus(AnsweringStatus, version=1):
    """From the level of hybrid control to the motion server."""

    sensed: int = field(unit="tick", doc="tick of the wrench; -1: none yet")
    wrench: np.ndarray = field(
        unit="N, N m", doc="of the contact, at the tool, in the task frame", shape=AXES
    )
    wanted: np.ndarray = field(unit="N, N m", doc="on the axes of force; others 0", shape=AXES)
    selected: np.ndarray = field("u1", unit="1", doc="1: an axis of force", shape=AXES)
    offset: np.ndarray = field(
        unit="m",
        doc="from where the motion alone would have the tool to where it is commanded",
        shape=3,
    )
    struck: int = field(
        "u4", unit="1", doc="id of the newest command whose guard was struck; 0: none"
    )
    axis: int = field("i2", unit="1", doc="axis on which that was; -1: none")


class ServerRequest(MotionRequest, version=1):
    """From a client to a server of force and motion: a `MotionRequest`, or

    - COMPLY: what follows is done with these axes of force. It is done when their forces are as
      wanted, or, without any, when the arm rests where compliance left it.
    - GUARD: the next of these wrenches ends the request under way, GUARDED; the guard ends with it.
    Those after it go on.

    Kind NONE with id 0 is a sign of life: without one, or a request, the server's client counts as
    lost.
    """

    frame: np.ndarray = field(
        unit="1", doc="task frame of COMPLY and GUARD, as in COMPLIANCE", shape=4
    )
    selected: np.ndarray = field(
        "u1",
        unit="1",
        doc="of COMPLY, 1: an axis of force; none: motion alone, no guard",
        shape=AXES,
    )
    wrench: np.ndarray = field(
        unit="N, N m", doc="of COMPLY: wanted of the tool on the surroundings", shape=AXES
    )
    speed: np.ndarray = field(
        unit="m/s, rad/s",
        doc="of COMPLY: most on the axes of force; 0: the level's default",
        shape=AXES,
    )
    guard: np.ndarray = field(
        unit="N, N m",
        doc="of GUARD: wrench, either way, that ends a segment; 0: not guarded",
        shape=AXES,
    )


class ServerState(MotionState, version=1):
    """As `MotionState`; what is in force says the level's own `Compliance`."""

    goal: np.ndarray = field(
        ServerRequest,
        doc="the request at whose goal the arm is, or to which it goes; id 0: none",
    )
    requests: np.ndarray = field(ServerRequest, doc="taken and not ended, oldest first", shape=HELD)


class Mode(IntEnum):
    """What a server of force and motion does."""

    MOTION = 0
    FORCE = 1  # some axes are of force
    HELD = 2  # the same without its client: at rest on the axes of motion, for a bounded time
    RELEASING = 3  # the time is over: the forces go to zero
    RELEASED = (
        4  # and the arm holds its position; a CANCEL ends this, as it ends HELD and RELEASING
    )


class ServerStatus(MotionStatus, version=1):
    """Requests as the server keeps them, from taking to end, and the contact."""

    mode: Mode = field(doc="motion, force, or what is left of it without a client")
    place: np.ndarray = field(unit="m", doc="tool position as sensed", shape=3)
    quaternion: np.ndarray = field(unit="1", doc="tool orientation as sensed, w, x, y, z", shape=4)
    frame: np.ndarray = field(unit="1", doc="orientation of the task frame, w, x, y, z", shape=4)
    wrench: np.ndarray = field(
        unit="N, N m", doc="of the tool on the surroundings, in the task frame", shape=AXES
    )
    wanted: np.ndarray = field(
        unit="N, N m", doc="the same as wanted, on the axes of force; others 0", shape=AXES
    )
    selected: np.ndarray = field("u1", unit="1", doc="1: an axis of force", shape=AXES)
    guarded: int = field("u4", unit="1", doc="newest request that a guard has ended; 0: none yet")
    axis: int = field("i2", unit="1", doc="axis on which that was; -1: none yet")
