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


class MinedBox:
    """Words in shared memory, each store of which counts."""

    def __init__(self, words: memoryview, bomb: Bomb) -> None:
        self._words, self._bomb = words, bomb

    def __getitem__(self, at: Any) -> Any:
        return self._words[at]

    def __setitem__(self, at: int, value: int) -> None:
        self._bomb.count()
        self._words[at] = value


class MinedSlot:
    """A slot into which every word is stored alone, in an order of the bomb's choice."""

    def __init__(self, place: memoryview, bomb: Bomb) -> None:
        self._place, self._bomb = place, bomb

    def __getitem__(self, part: slice) -> memoryview:
        return self._place[part]

    def __setitem__(self, part: slice, content: Any) -> None:
        view = self._place[part]
        for at in range(0, len(view), 8):
            self._bomb.count()
            view[at : at + 8] = content[at : at + 8]


def mine(writer: Writer, bomb: Bomb) -> None:
    """Let every store of a writer to shared memory count."""
    slots: Any = writer.slots
    slots.box = MinedBox(slots.box, bomb)
    writer.claim._box = MinedBox(writer.claim._box, bomb)  # type: ignore[assignment]
    slots.places = [MinedSlot(place, bomb) for place in slots.places]
    slots.heads = [MinedBox(words, bomb) for words in slots.heads]
