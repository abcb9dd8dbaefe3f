"""`[record]`: what is kept of a run; by default everything."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from rack.boards.faults.config import as_seconds
from rack.levels.tables import Table

Span = Annotated[float, BeforeValidator(as_seconds), Field(ge=0, le=1e6, allow_inf_nan=False)]
Stretch = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False), BeforeValidator(as_seconds)]


class RecordConfig(Table):
    """`[record]`: with `keep`, a flight recorder, which keeps the last stretch of a run, and for
    good what surrounds a fault, a detection, a miss, a hold, a restart or a lost row.
    """

    keep: Stretch | None = None
    """last stretch kept [s]; simulated time; also as in "10 min" or "30 s"; default: all"""
    before: Span = 5.0
    """kept before each of these [s]; also as in "5 s" """
    after: Span = 5.0
    """kept after each of these [s]; also as in "5 s" """

    @model_validator(mode="after")
    def _remembers(self) -> Self:
        """Refuse to remove what a window may still need: a fault may be found late."""
        if self.keep is not None and self.keep < self.before + self.after:
            raise ValueError(
                f"keep = {self.keep:g} s is shorter than before + after ="
                f" {self.before + self.after:g} s: what is before a fault would be gone"
            )
        return self
