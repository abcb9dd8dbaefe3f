"""The messages of force control: what the wrist senses, what is wanted of a contact, and how the contact is.

A task frame has its origin at the tool, and the orientation that the command gives. Of its six axes, three of
translation and three of rotation, each is either an axis of motion or one of force. Vectors of six are force, N, and
torque, N m, or velocity, m/s, and angular velocity, rad/s. A wrench is what the surroundings exert on the tool.
"""

from __future__ import annotations

from rack.backplane.message import Field, MessageType, command, status
from rack.levels.operator import ANSWER, RESTS_ON

AXES = 6
"""Axes of a task frame: translations along x, y, z, then rotations about them."""

WRENCH = MessageType(
    "wrench",
    1,
    (
        Field("tick", "i8", "tick", "tick at which it was sensed"),
        Field("wrench", "f8", "N, N m", "of the contact, at the tool, in the world's frame, without weights", (AXES,)),
        Field("sample", "f8", "N, N m", "as the sensor gives it, in the sensor's frame", (AXES,)),
        Field("saturated", "u1", "1", "1: the sensor is at the end of its range"),
        Field("exceeded", "u4", "1", "cycles in which the contact was beyond the arm's force limits"),
    ),
)
"""From the board of an arm with a wrist sensor, in every cycle."""

COMPLIANCE = command(
    "compliance",
    1,
    RESTS_ON,
    Field("active", "u1", "1", "1: some axis is one of force, or guarded; 0: motion alone"),
    Field("frame", "f8", "1", "orientation of the task frame in the world, w, x, y, z", (4,)),
    Field("selected", "u1", "1", "1: an axis of force; 0: of motion", (AXES,)),
    Field("wrench", "f8", "N, N m", "wanted of the tool on the surroundings, on the axes of force", (AXES,)),
    Field("speed", "f8", "m/s, rad/s", "most on the axes of force, both ways", (AXES,)),
    Field("guard", "f8", "N, N m", "wrench, either way, at which motion ends; 0: the axis is not guarded", (AXES,)),
)
"""From the motion server to the level of hybrid control. `id` rises with every change; a guard strikes once an id."""

FORCE_STATUS = status(
    "force_status",
    1,
    *ANSWER,
    Field("sensed", "i8", "tick", "tick of the wrench; -1: none yet"),
    Field("wrench", "f8", "N, N m", "of the contact, at the tool, in the task frame", (AXES,)),
    Field("wanted", "f8", "N, N m", "on the axes of force; others 0", (AXES,)),
    Field("selected", "u1", "1", "1: an axis of force", (AXES,)),
    Field("offset", "f8", "m", "from where the motion alone would have the tool to where it is commanded", (3,)),
    Field("struck", "u4", "1", "id of the newest command whose guard was struck; 0: none"),
    Field("axis", "i2", "1", "axis on which that was; -1: none"),
)
"""From the level of hybrid control to the motion server."""
