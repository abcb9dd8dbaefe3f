"""Obstacles that move by themselves: where they are is a pure function of time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import norm
from rack.levels.scene import MotionConfig

Array = NDArray[np.float64]


class ObstacleMotion:
    """The moves of one obstacle, one after the other; a move that starts before the last has ended cuts that off."""

    def __init__(self, start: Array, moves: tuple[MotionConfig, ...]) -> None:
        """Take the place `start` (3,), m, and the obstacle's moves."""
        self._start = np.array(start)
        self._moves = tuple(sorted(moves, key=lambda move: move.at))
        self._ends = (*(later.at for _, later in pairwise(self._moves)), np.inf)

    def position(self, time_s: float) -> Array:
        """Return the obstacle's origin (3,), m, at simulated `time_s`."""
        place = self._start
        for move, end in zip(self._moves, self._ends, strict=False):
            if time_s <= move.at:
                break
            way = np.array(move.to) - place
            length = norm(way)
            driven = move.speed * (min(time_s, end) - move.at)
            place = np.array(move.to) if driven >= length else place + way * (driven / length)
        return place
