"""Levels whose next message depends on all that they remember, in every kind of attribute."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import count

import numpy as np

from rack.backplane.message import State
from rack.levels.level import Executor, LevelContext, Output
from tests.boards.wave_levels import WaveStatus


class Turn:
    """Something made while the level runs."""

    __slots__ = ("of", "size")

    def __init__(self, of: np.ndarray, size: float) -> None:
        self.of = of
        self.size = size

    def taken(self) -> float:
        """Take the turn."""
        self.of[0] += self.size
        return float(self.of[0])


def counter() -> Callable[[], int]:
    """Return a function that counts its calls."""
    calls = 0

    def call() -> int:
        nonlocal calls
        calls += 1
        return calls

    return call


class Rememberer(Executor):
    """Writes a number into which all of its past goes."""

    status = Output(WaveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._factor = float(context.params.get("factor", 1.0))
        self._half = self._factor / 2
        self._table = np.zeros((2, 3))
        self._row = self._table[1]
        self._recent: deque[int] = deque(maxlen=5)
        self._list: list[float] = []
        self._seen: dict[int, float] = {}
        self._odd: set[int] = set()
        self._raw = bytearray(4)
        self._call = counter()
        self._turn: Turn | None = None
        self._next: Callable[[], float] | None = None

    def process(self, tick: int) -> None:
        """Remember more, and write what comes of it."""
        self._recent.append(tick % 7)
        self._list.append(0.25 * tick)
        self._seen[tick % 11] = self._list[-1]
        self._odd ^= {tick % 13}
        self._raw[tick % 4] = (self._raw[tick % 4] + 3) % 256
        if tick == 20:
            # A view, an object and a bound method that the constructor did not make.
            self._turn = Turn(self._row[1:], 0.125)
            self._next = self._turn.taken
        turned = 0.0 if self._next is None else self._next()
        self.status.state = State.EXECUTING
        self.status.message = self._factor * (
            self._half
            + self._call()
            + self._table.sum()
            + turned
            + sum(self._recent)
            + sum(self._list) / len(self._list)
            + sum(self._seen.values())
            + sum(self._odd)
            + sum(self._raw)
        )


class Generator(Executor):
    """Remembers in something that nobody can copy."""

    status = Output(WaveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._count = count()

    def process(self, tick: int) -> None:
        """Write the next number."""
        self.status.message = float(next(self._count))


class LateGenerator(Generator):
    """The same, but it makes that only while it runs."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        del self._count

    def process(self, tick: int) -> None:
        """Write the next number."""
        if tick == 10:
            self._count = (number for number in range(1 << 40))  # type: ignore[assignment]
        self.status.message = float(tick)
