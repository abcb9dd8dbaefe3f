"""Plan and status of the level of figures 2 to 4: they tell which plan is in force."""

from __future__ import annotations

from rack.backplane.message import Field, MessageType, status

FIGURE_PLAN = MessageType(
    "figure_plan",
    1,
    (
        Field("made_at", "i8", "tick", "release that the plan answers"),
        Field("cycle", "i8", "tick", "cycle of the executor whose status the plan rests on; -1: none was there"),
    ),
)
FIGURE_STATUS = status(
    "figure_status",
    1,
    Field("cycle", "i8", "tick", "release of this cycle"),
    Field("plan", "i8", "tick", "release that the plan in force answers; -1: there is none yet"),
)
