"""Levels whose next message depends on all that they remember, in every kind of attribute."""

from __future__ import annotations

import ctypes
import random
from collections import deque
from collections.abc import Callable
from itertools import count
from pathlib import Path
from select import epoll
from socket import socket
from threading import Event, Thread
from typing import Any

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
        self.status.value = self._factor * (
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


class Holder(Executor):
    """Writes a number that depends on what no program can copy piece by piece: a file that it
    reads, generators of numpy, Python and the C library, an iterator, and a closure."""

    status = Output(WaveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._file = Path(__file__).open("rb")  # noqa: SIM115  closed in `close`
        self._generator = np.random.default_rng(7)
        random.seed(8)
        self._libc = ctypes.CDLL(None)
        self._libc.srand(9)
        self._count = count()
        self._numbers = (number * number for number in range(1 << 40))
        self._call = counter()

    def process(self, tick: int) -> None:
        """Write the next number."""
        if not (line := self._file.readline()):
            self._file.seek(0)
        drawn = self._generator.random() + random.random() + self._libc.rand() % 1000
        counted = next(self._count) + next(self._numbers) + self._call()
        self.status.state = State.EXECUTING
        self.status.value = len(line) + drawn + counted

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Uncopied(Executor):
    """Has what no copy can have: a file that it writes, a socket, an epoll object or a thread."""

    status = Output(WaveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._ends = Event()
        self._thread = Thread(target=self._ends.wait, args=(60.0,), daemon=True)
        self._held: Any = None
        match context.params["holds"]:
            case "file":
                self._held = Path(context.params["path"]).open("a")  # noqa: SIM115
            case "socket":
                self._held = socket()
            case "epoll":
                self._held = epoll()
            case "thread":
                self._thread.start()

    def process(self, tick: int) -> None:
        """Write the tick."""
        self.status.value = float(tick)

    def close(self) -> None:
        """Let go of all."""
        self._ends.set()
        if self._held is not None:
            self._held.close()
