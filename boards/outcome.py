"""How a run ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Cause = Literal["task done", "task refused", "task failed", "time over", "stopped", "board lost", "launcher lost"]
"""A task is refused when it was never begun: it has no moves. Any other that ends with an error has failed."""


@dataclass(frozen=True)
class Outcome:
    """The end of a run: why, after how many ticks, and the digest of what was written until then.

    `state` and `reason` are of the level that ends the run; `faults` names what is latched.
    """

    cause: Cause
    ticks: int
    state: str
    reason: str
    digest: str
    faults: tuple[str, ...]

    @property
    def worked(self) -> bool:
        """Whether the run did what it was for: no fault, and no task that was refused, failed or was cut short."""
        return not self.faults and self.cause in ("task done", "time over")
