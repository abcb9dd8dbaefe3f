"""What faulty writers make of their messages: see `tests.levels.box.Disturbance`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tests.levels.box import Disturbance

Shown = Sequence[tuple[int, bytes | None]]


def mute(visible_at: int, data: bytes) -> Shown:
    """Publish nothing."""
    return ()


def lose_some(probability: float, seed: int) -> Disturbance:
    """Damage messages with that probability; a dropped one is the same to a reader: a serial without a message."""
    chance = np.random.default_rng(seed)
    return lambda visible_at, data: ((visible_at, None if chance.random() < probability else data),)


def hold_back(ticks: int) -> Disturbance:
    """Show every message so much later, the last ones behind those that come when the fault is over."""
    return lambda visible_at, data: ((visible_at + ticks, data),)


class SwapPairs:
    """Exchanges two messages with that probability: the older one is shown as the newest."""

    def __init__(self, probability: float, seed: int) -> None:
        self._probability = probability
        self._chance = np.random.default_rng(seed)
        self._kept: bytes | None = None

    def __call__(self, visible_at: int, data: bytes) -> Shown:
        kept, self._kept = self._kept, None
        if kept is not None:
            return (visible_at, data), (visible_at, kept)
        if self._chance.random() < self._probability:
            self._kept = data
            return ()
        return ((visible_at, data),)
