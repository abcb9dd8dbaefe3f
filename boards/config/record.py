"""The table `[record]`: how much of a run the recorder keeps. By default everything."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from rack.boards.faults.config import parse_seconds
from rack.levels.tables import Table

Span = Annotated[float, BeforeValidator(parse_seconds), Field(ge=0, le=1e6, allow_inf_nan=False)]
Stretch = Annotated[float, Field(ge=1, le=1e6, allow_inf_nan=False), BeforeValidator(parse_seconds)]
DEFAULT_SPAN_S = 5.0
"""Default time that is kept before and after an event."""


class RecordConfig(Table):
    """`[record]`: flight recorder, if `keep` is given.

    It keeps the last part of a run, and permanently the time around each fault, detection, missed
    cycle, hold, restart and lost row.
    """

    keep: Stretch | None = None
    """time at the end of the run that is kept [s]; simulated time; also as in "10 min" or "30 s";
    default: all"""
    before: Span = DEFAULT_SPAN_S
    """time kept before each such event [s]; also as in "5 s" """
    after: Span = DEFAULT_SPAN_S
    """time kept after each such event [s]; also as in "5 s" """

    @model_validator(mode="after")
    def _check_windows(self) -> Self:
        """Check that `keep` is at least `before` plus `after`, which have no meaning without it.

        A fault may be detected late, and the time before it must not yet be discarded.
        """
        if self.keep is None and (self.before, self.after) != (DEFAULT_SPAN_S, DEFAULT_SPAN_S):
            raise ValueError("before and after need keep; without it everything is kept")
        if self.keep is not None and self.keep < self.before + self.after:
            raise ValueError(
                f"keep = {self.keep:g} s is shorter than before + after ="
                f" {self.before + self.after:g} s; rows from before a fault would be lost"
            )
        return self
