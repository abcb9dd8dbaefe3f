"""Where a task takes objects, and how far from there they ended."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # A look at a running rack must not import the levels.
    from rack.levels.algebra import Array
    from rack.levels.tables import GoalConfig


@dataclass(frozen=True)
class ObjectEnd:
    """The goal of an object, and where it ended, m."""

    object: str
    goal: Sequence[float]
    ended: Sequence[float]
    off_mm: float
    tolerance_mm: float

    def __str__(self) -> str:
        return (
            f"object '{self.object}' ended {self.off_mm:.0f} mm from its goal (tolerance"
            f" {self.tolerance_mm:g} mm)"
        )


def ends(goals: Mapping[int, GoalConfig], position: Array) -> Iterator[ObjectEnd]:
    """Yield the end of every object that has a goal, by its row in `position`, (bodies, 3), m."""
    for row, goal in goals.items():
        ended = position[row].tolist()
        off_mm = round(1e3 * math.dist(ended, goal.position), 3)
        yield ObjectEnd(goal.object, goal.position, ended, off_mm, goal.tolerance_mm)
