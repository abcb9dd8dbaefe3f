"""What a config may set of the task level, in `[board.<name>.params]`."""

from __future__ import annotations

from pydantic import Field

from rack.levels.tables import Positive, Table


class TaskParams(Table):
    """What the levels below need at most, for the promise of a time, and how long they may stand still.

    In s of simulated time.
    """

    beginning: Positive = Field(0.1, description="from a segment's arrival in the primitive level to motion, s")
    settling: Positive = Field(0.2, description="from the end of a motion to the report that it is done, s")
    gripping: Positive = Field(0.6, description="time that the gripper takes to open or close and to settle, s")
    stalled_s: Positive = Field(
        90.0,
        description="time without any progress after which the task ends, unless an operator holds it; longer than "
        "the patience of the level below, s",
    )
