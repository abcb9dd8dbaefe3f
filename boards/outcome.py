"""How a run ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Cause = Literal["task done", "task refused", "time over", "stopped", "board lost", "launcher lost"]


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
        """Whether the run did what it was for: no fault, and no task that was refused or cut short."""
        return not self.faults and self.cause in ("task done", "time over")
