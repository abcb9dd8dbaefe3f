"""What a config may set of the primitive level, in `[board.<name>.params]`."""

from __future__ import annotations

from pydantic import Field

from rack.levels.tables import Positive, Table


class PrimitiveParams(Table):
    """Bounds of following, settling and guarding."""

    following: Positive = Field(0.05, description="largest distance of a joint from its set point under way, rad")
    straying: Positive = Field(0.1, description="time that a joint may be farther than that before it is an error, s")
    settled: Positive = Field(0.003, description="largest distance of a settled joint from its goal, rad")
    settled_opening: Positive = Field(0.002, description="largest speed of a settled gripper, m/s")
    settled_cycles: int = Field(3, ge=1, le=100, description="cycles in a row that a settled arm stays so")
    settling: Positive = Field(3.0, description="longest time that arm or gripper may take to settle, s")
    astray: Positive = Field(0.02, description="largest distance of a joint from the path when motion begins, rad")
    bridging: Positive = Field(0.5, description="time in which such a distance is taken back, s")
    silent: Positive = Field(10.0, description="time without status from below, restarts included, that is an error, s")
    blind: Positive = Field(0.2, description="time without a new scene in the world model after which motion holds, s")
    braking: float = Field(
        1.5, ge=1.0, le=3.0, description="multiple of the planned acceleration and jerk limits that a hold may use"
    )
    lookahead: Positive = Field(2.0, description="time ahead of the arm that the guard watches in every cycle, s")
    clear: Positive = Field(0.5, description="time that the way must be clear before held motion goes on, s")
