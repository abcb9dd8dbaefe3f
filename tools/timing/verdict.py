"""One equation of the timing model, put to one level, core or rack."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any


@dataclass(frozen=True)
class Verdict:
    """Two sides of an equation and whether it holds, for predictions and measurements alike.

    `equation` is the paper's number, "3.8", or "response time" for what goes beyond the paper. `subject` is a board,
    a task, or "system". `left` and `right` are ns, or shares of a cycle where `unit` is "1"; `sign` stands between
    them, "<=". `margin` is what is left, in the same unit: negative where the equation fails. `meaning` says both
    sides in the paper's terms, as in "t_plan / d < t_residual - 2 t_cs".
    """

    equation: str
    subject: str
    left: float
    sign: str
    right: float
    holds: bool
    meaning: str
    unit: str = "ns"

    @property
    def margin(self) -> float:
        """What is left of the right side."""
        return self.right - self.left

    def document(self) -> dict[str, Any]:
        """Return it as plain data, the margin with it; a side without a bound is None."""
        sides = {"left": self.left, "right": self.right, "margin": self.margin}
        return asdict(self) | {name: side if isfinite(side) else None for name, side in sides.items()}
