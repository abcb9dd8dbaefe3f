"""What a config may set of the servo level, in `[board.<name>.params]`."""

from __future__ import annotations

from pydantic import Field

from levels.robot import Positive, Table


class ServoParams(Table):
    """Gains of the joint loop."""

    bandwidth: Positive = Field(60.0, le=400.0, description="natural frequency of the error in every joint, rad/s")
    damping: Positive = Field(1.0, le=3.0, description="damping ratio of the error")
