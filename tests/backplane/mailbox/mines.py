"""Memory whose stores are counted, so that a process ends or stops itself before a chosen one."""

from __future__ import annotations

import os
import signal
from typing import Any

from rack.backplane.mailbox.mailbox import Writer


class Bomb:
    """Sends a signal to this process before one of its stores to shared memory.

    Attributes:
        left: Number of stores before that one. Negative once the signal was sent.
    """

    def __init__(self, number: int, kind: signal.Signals = signal.SIGKILL) -> None:
        self.left = number
        self._kind = kind

    def count(self) -> None:
        if not self.left:
            os.kill(os.getpid(), self._kind)
        self.left -= 1


class Mined:
    """Shared memory, each store to which counts; of a slice, every word is stored alone."""

    def __init__(self, memory: memoryview, bomb: Bomb) -> None:
        self._memory, self._bomb = memory, bomb

    def __getitem__(self, at: Any) -> Any:
        return self._memory[at]

    def __setitem__(self, at: int | slice, value: Any) -> None:
        if isinstance(at, int):
            self._bomb.count()
            self._memory[at] = value
            return
        view = self._memory[at]
        for start in range(0, len(view), 8):
            self._bomb.count()
            view[start : start + 8] = value[start : start + 8]


def mine(writer: Writer, bomb: Bomb) -> None:
    """Let every store of a writer to shared memory count."""
    slots: Any = writer.slots
    slots.box = Mined(slots.box, bomb)
    writer.claim._box = Mined(writer.claim._box, bomb)  # type: ignore[assignment]
    slots.places = [Mined(place, bomb) for place in slots.places]
    slots.heads = [Mined(words, bomb) for words in slots.heads]
