"""A mailbox of a rack in one process, and faults of its writers."""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rack.backplane.message import Message

SILENT_CYCLES = 4
"""Age of a message, in its writer's cycles, at which the writer is silent: 3, and one to wait."""
Shown = Sequence[tuple[int, bytes | None]]
Disturbance = Callable[[int, bytes], Shown]
"""A writer's fault: messages shown instead of one, and when. None stands for a damaged one."""


class Box:
    """A mailbox under time-slice: messages wait until they are visible.

    `every`: cycle of the writer. None for planners and tests, which do not write in each cycle.
    `lost`: the writer is known to be dead or to hang.
    """

    def __init__(self, kind: type[Message], sizes: Mapping[str, int], every: int | None = None):
        self.kind, self.dtype = kind, kind.message_type.build_dtype(sizes)
        self.lost = False
        self.disturbance: Disturbance | None = None
        self._every = every
        self._waiting: list[tuple[int, bytes | None]] = []
        self._now: bytes | None = bytes(self.dtype.itemsize)
        self._good = bytes(self.dtype.itemsize)
        self._serial = 0
        self._good_since = 0

    def publish(self, message: Message, visible_at: int) -> None:
        """Make `message` visible from tick `visible_at` on, unless a fault interferes."""
        data = bytes(message.raw)
        shown: Shown = ((visible_at, data),)
        if self.disturbance is not None:
            shown = self.disturbance(visible_at, data)
        for one in shown:
            insort(self._waiting, one, key=lambda waiting: waiting[0])

    def withdraw(self, tick: int) -> None:
        """Undo messages not yet visible at `tick`: their writer died before they were finished."""
        self._waiting = [one for one in self._waiting if one[0] <= tick]

    def at(self, tick: int) -> tuple[int, bytes | None]:
        """Return serial and bytes of the newest visible message: 0 if none, None if damaged."""
        while self._waiting and self._waiting[0][0] <= tick:
            since, self._now = self._waiting.pop(0)
            self._serial += 1
            if self._now is not None:
                self._good, self._good_since = self._now, since
        return self._serial, self._now

    def good_at(self, tick: int) -> bytes:
        """Return the newest whole message visible at `tick`."""
        self.at(tick)
        return self._good

    def is_lost(self, tick: int) -> bool:
        """Say whether the writer is lost or silent for its readers."""
        if self.lost or self._every is None or not self._serial:
            return self.lost and self._serial > 0
        return tick - (self._good_since - self._every) >= SILENT_CYCLES * self._every


def mute(visible_at: int, data: bytes) -> Shown:
    return ()


def lose_some(probability: float, seed: int) -> Disturbance:
    """Damage messages with that probability; to a reader, dropped ones are the same."""
    chance = np.random.default_rng(seed)
    return lambda visible_at, data: ((visible_at, None if chance.random() < probability else data),)


def hold_back(ticks: int) -> Disturbance:
    """Show every message `ticks` later, the last ones after those that follow the fault."""
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
