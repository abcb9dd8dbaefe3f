"""What a config may set of the level of figures 2 to 4, in `[board.<name>.params]`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rack.levels.robot import Table

NS_PER_MS = 1e6
Milliseconds = Annotated[float, Field(ge=0, le=10_000, allow_inf_nan=False)]


class FigureParams(Table):
    """Processor times of the level's unit functions; R, W, U and C are the bus's, in `[board.<name>.transfer]`."""

    process_ms: Milliseconds | Annotated[tuple[Milliseconds, ...], Field(min_length=1)] = Field(
        2.0, description="X: the executor in a cycle, ms; several times are taken in turn, cycle by cycle"
    )
    plan_ms: Milliseconds = Field(6.0, description="P: one plan, without its update, ms")

    @property
    def process_ns(self) -> tuple[int, ...]:
        """X by cycle, ns; it begins again behind the last."""
        times = self.process_ms if isinstance(self.process_ms, tuple) else (self.process_ms,)
        return tuple(round(ms * NS_PER_MS) for ms in times)

    @property
    def plan_ns(self) -> int:
        """P, ns."""
        return round(self.plan_ms * NS_PER_MS)
