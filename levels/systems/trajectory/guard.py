"""The guard of a motion: a lasting change of a joint's torque, as where the arm meets something,
ends it.

Torques also change when the arm brakes, holds, or goes on after missed cycles. This level sees all
of these; a change across one of them is no touch: the window begins anew, and only in steady
motion.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from rack.levels.algebra import Array
from rack.levels.level import Reading

LASTS_S = 0.04
"""Parts of the window, at its begin and end, whose medians are compared: what a late cycle or a
short braking leaves behind decays within half of it. The window is five times as long: over more,
slow motion changes torques by itself."""


class TouchGuard:
    """Compares torques, N m, at the end of its window with those at its begin; one sample a
    cycle."""

    def __init__(self, period_s: float) -> None:
        self._lasting = max(round(LASTS_S / period_s), 3)
        self._past: deque[Array] = deque(maxlen=5 * self._lasting)

    def begin_anew(self) -> None:
        """Forget the torques so far."""
        self._past.clear()

    def is_struck(self, boards: Mapping[str, Reading], most: float) -> bool:
        """Return whether the torque of a joint has changed by more than `most`, N m."""
        if all(board.is_new and not board.value.holding for board in boards.values()):
            self._past.append(sum(board.value.torque for board in boards.values()))
        else:
            self.begin_anew()
        past = np.array(self._past)
        count = self._lasting
        if len(past) < 2 * count:
            return False
        change = np.median(past[-count:], axis=0) - np.median(past[:count], axis=0)
        return bool(np.abs(change).max() > most)
