"""An equation of the timing model, put to numbers: two sides and the sign between them."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Literal, NamedTuple

Sign = Literal["<", "<=", "="]

_HOLDS: dict[str, Callable[[float, float], bool]] = {"<": operator.lt, "<=": operator.le, "=": operator.eq}


class Relation(NamedTuple):
    """Two sides, in one unit, and the sign between them; it is true where it holds."""

    left: float
    sign: Sign
    right: float

    @property
    def holds(self) -> bool:
        """Whether the numbers are so."""
        return _HOLDS[self.sign](self.left, self.right)

    @property
    def margin(self) -> float:
        """What the right side has to spare; below 0 the relation fails."""
        return self.right - self.left

    def __bool__(self) -> bool:
        """Return whether it holds: a tuple of three would always be true."""
        return self.holds
