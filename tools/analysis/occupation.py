"""Stretches of time in which somebody had a core, and how much of a given stretch they fill."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Occupation:
    """A union of stretches of time, ns; they may overlap."""

    def __init__(self, starts: np.ndarray, ends: np.ndarray) -> None:
        """Take stretches from `starts` to `ends`, each of shape (n,), in any order."""
        order = np.argsort(starts, kind="stable")
        starts, ends = starts[order], np.maximum.accumulate(np.maximum(starts, ends)[order])
        # A stretch that begins behind the end of all before it begins a new block.
        first = np.ones(len(starts), bool)
        first[1:] = starts[1:] > ends[:-1]
        self._starts = starts[first]
        self._ends = ends[np.roll(first, -1)] if len(ends) else ends
        self._before = np.concatenate(([0], np.cumsum(self._ends - self._starts)))

    @classmethod
    def of_all(cls, many: Sequence[Occupation]) -> Occupation:
        """Return the union of several."""
        none = np.empty(0, np.int64)
        return cls(
            np.concatenate([none, *(each._starts for each in many)]),
            np.concatenate([none, *(each._ends for each in many)]),
        )

    def within(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return how much of each stretch from `starts` to `ends` is occupied, ns, shape as given."""
        return np.asarray(self._until(ends) - self._until(starts))

    def _until(self, times: np.ndarray) -> np.ndarray:
        """Return the time that is occupied before each of `times`."""
        begun = np.searchsorted(self._starts, times, side="right")
        if not len(self._starts):
            return np.zeros(np.shape(times), np.int64)
        newest = np.maximum(begun - 1, 0)
        beyond = np.clip(self._ends[newest] - times, 0, None)
        return np.asarray(np.where(begun > 0, self._before[begun] - beyond, 0))
