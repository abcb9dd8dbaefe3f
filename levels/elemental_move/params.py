"""What a config may set of the elemental move level, in `[board.<name>.params]`."""

from __future__ import annotations

from pydantic import Field

from rack.levels.tables import Positive, Table


class ElementalMoveParams(Table):
    """Bounds of patience, of grasping, and of what the levels below need to answer."""

    patience: Positive = Field(60.0, description="time that a move waits for a free path before it is an error, s")
    retry: Positive = Field(2.0, description="time after which a path is searched again in a world at rest, s")
    replans: int = Field(
        10, ge=1, le=1000, description="other paths that one move may take before a blocked way is an error"
    )
    grasp_gap: Positive = Field(0.002, description="a gripper closer to closed than this holds nothing, m or rad")
    answer: Positive = Field(0.3, description="time that settling and the report from below may take, s")
