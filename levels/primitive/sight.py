"""What the level sees of the world: whether that is fresh enough to move by, and how the held object sits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.level import Reading
from rack.levels.primitive.guard import Guard

Array = NDArray[np.float64]


class Sight:
    """Holds motion while the world model is old, and shows the guard how an object sits in the gripper.

    The model may be old because its board is lost, or because it is not told of the scene itself: what counts is when
    the scene was seen.
    """

    def __init__(self, guard: Guard, blind_ticks: int, has_bodies: bool) -> None:
        """Count a world unseen for `blind_ticks` as not seen; without bodies there is nothing to see."""
        self._guard = guard
        self._blind_ticks = blind_ticks
        self._has_bodies = has_bodies
        self._blind = has_bodies
        self._waiting: tuple[int, int] | None = None

    def carry(self, row: int | None, since: int) -> None:
        """Take object `row` along from where a scene seen at tick `since` or later shows it; None: carry nothing."""
        self._waiting = (row, since) if row is not None else None
        if row is None:
            self._guard.carry_nothing()

    def update(self, world: Reading, q: Array, tick: int) -> None:
        """Look at the newest world model; `q` (joints,), rad, is where the arm rests."""
        model = world.value
        seen = world.is_there and model.revision > 0
        self._blind = self._has_bodies and (not seen or tick - model.sensed > self._blind_ticks)
        if self._waiting is not None and seen and model.sensed >= self._waiting[1]:
            self._guard.carry(self._waiting[0], q, model)
            self._waiting = None

    @property
    def lacks(self) -> str:
        """What must be seen before motion may go on; empty: nothing."""
        if self._blind:
            return "world model is stale: waiting for a new scene"
        return "waiting for a scene that shows what is held" if self._waiting is not None else ""
