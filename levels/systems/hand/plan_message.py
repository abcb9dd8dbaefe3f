"""A plan of a grasp: where the fingers take hold of an object, and from which posture they
close."""

from __future__ import annotations

from rack.backplane.message import Field, command
from rack.levels.operator import RESTS_ON

GRASP_PLAN = command(
    "grasp_plan",
    1,
    RESTS_ON,
    Field("object", "i2", "1", "row of the object in the world model"),
    Field("sensed", "i8", "tick", "tick of the world model that it rests on"),
    Field("posture", "f8", "rad", "joint positions from which the fingers close", ("joints",)),
    Field(
        "contact",
        "f8",
        "m",
        "of each tip, on the object's surface, in the object's frame",
        ("fingers", 3),
    ),
    Field(
        "normal",
        "f8",
        "1",
        "direction of each tip's force there, in the object's frame",
        ("fingers", 3),
    ),
    Field("grip", "f8", "N", "force of each finger; the opposing one bears their sum"),
)
"""From a planner, on a board or on the host side, to the grasp loop. The newest with an `id` above
0 counts."""
