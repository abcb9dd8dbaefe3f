"""The messages of force control: what the wrist senses, what is wanted of a contact, and how the
contact is.

A task frame has its origin at the tool, and the orientation that the command gives. Of its six
axes, three of translation and three of rotation, each is either an axis of motion or one of force.
Vectors of six are force, N, and torque, N m, or velocity, m/s, and angular velocity, rad/s. A
wrench is what the surroundings exert on the tool.
"""

from __future__ import annotations

from enum import IntEnum

from rack.backplane.message import Field, MessageType, command, status
from rack.levels.fields import flag, number, real, row, tick
from rack.levels.operator import ANSWER, RESTS_ON
from rack.levels.systems.trajectory.messages import MOTION_REQUEST, MOTION_STATUS, state_of

AXES = 6
"""Axes of a task frame: translations along x, y, z, then rotations about them."""

WRENCH = MessageType(
    "wrench",
    1,
    (
        tick("tick", "tick at which it was sensed"),
        real(
            "wrench",
            "N, N m",
            "of the contact, at the tool, in the world's frame, without weights",
            AXES,
        ),
        real("sample", "N, N m", "as the sensor gives it, in the sensor's frame", AXES),
        flag("saturated", "1: the sensor is at the end of its range"),
        number("exceeded", "cycles in which the contact was beyond the arm's force limits"),
    ),
)
"""From the board of an arm with a wrist sensor, in every cycle."""

COMPLIANCE = command(
    "compliance",
    1,
    RESTS_ON,
    flag("active", "1: some axis is one of force, or guarded; 0: motion alone"),
    real("frame", "1", "orientation of the task frame in the world, w, x, y, z", 4),
    flag("selected", "1: an axis of force; 0: of motion", AXES),
    real("wrench", "N, N m", "wanted of the tool on the surroundings, on the axes of force", AXES),
    real("speed", "m/s, rad/s", "most on the axes of force, both ways", AXES),
    real(
        "guard",
        "N, N m",
        "wrench, either way, at which motion ends; 0: the axis is not guarded",
        AXES,
    ),
)
"""From the motion server to the level of hybrid control. `id` rises with every change; a guard
strikes once an id."""

FORCE_STATUS = status(
    "force_status",
    1,
    *ANSWER,
    tick("sensed", "tick of the wrench; -1: none yet"),
    real("wrench", "N, N m", "of the contact, at the tool, in the task frame", AXES),
    real("wanted", "N, N m", "on the axes of force; others 0", AXES),
    flag("selected", "1: an axis of force", AXES),
    real(
        "offset", "m", "from where the motion alone would have the tool to where it is commanded", 3
    ),
    number("struck", "id of the newest command whose guard was struck; 0: none"),
    row("axis", "axis on which that was; -1: none"),
)
"""From the level of hybrid control to the motion server."""

SERVER_REQUEST = MessageType(
    "server_request",
    1,
    (
        *MOTION_REQUEST.fields,
        real("frame", "1", "task frame of COMPLY and GUARD, as in COMPLIANCE", 4),
        flag("selected", "of COMPLY, 1: an axis of force; none: motion alone, no guard", AXES),
        real("wrench", "N, N m", "of COMPLY: wanted of the tool on the surroundings", AXES),
        real(
            "speed",
            "m/s, rad/s",
            "of COMPLY: most on the axes of force; 0: the level's default",
            AXES,
        ),
        real(
            "guard",
            "N, N m",
            "of GUARD: wrench, either way, that ends a segment; 0: not guarded",
            AXES,
        ),
    ),
)
"""From a client to a server of force and motion: a `MOTION_REQUEST`, or

- COMPLY: what follows is done with these axes of force. It is done when their forces are as wanted,
  or, without any, when the arm rests where compliance left it.
- GUARD: the next of these wrenches ends the request under way, GUARDED; the guard ends with it.
  Those after it go on.

Kind NONE with id 0 is a sign of life: without one, or a request, the server's client counts as
lost.
"""

SERVER_STATE = state_of("server_state", SERVER_REQUEST)
"""See `MOTION_STATE`; what is in force says the level's own `COMPLIANCE`."""


class Mode(IntEnum):
    """What a server of force and motion does."""

    MOTION = 0
    FORCE = 1  # some axes are of force
    HELD = 2  # the same without its client: at rest on the axes of motion, for a bounded time
    RELEASING = 3  # the time is over: the forces go to zero
    RELEASED = (
        4  # and the arm holds its position; a CANCEL ends this, as it ends HELD and RELEASING
    )


SERVER_STATUS = MessageType(
    "server_status",
    1,
    (
        *MOTION_STATUS.fields,
        Field("mode", "u1", Mode, "motion, force, or what is left of it without a client"),
        real("place", "m", "tool position as sensed", 3),
        real("quaternion", "1", "tool orientation as sensed, w, x, y, z", 4),
        real("frame", "1", "orientation of the task frame, w, x, y, z", 4),
        real("wrench", "N, N m", "of the tool on the surroundings, in the task frame", AXES),
        real("wanted", "N, N m", "the same as wanted, on the axes of force; others 0", AXES),
        flag("selected", "1: an axis of force", AXES),
        number("guarded", "newest request that a guard has ended; 0: none yet"),
        row("axis", "axis on which that was; -1: none yet"),
    ),
)
"""Requests as the server keeps them, from taking to end, and the contact."""
