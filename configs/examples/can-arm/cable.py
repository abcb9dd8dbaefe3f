"""The cable from a drive to the bus, with simulated disturbances."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from time import monotonic, time

import can
from wire import DISTURB, SPAN, Frame, receive, send


class Disturbance(IntEnum):
    """Disturbances of a drive or its cable. The unit of their size is in brackets."""

    NONE = 0
    UNPLUGGED = 1
    BUS_OFF = 2  # the drive's controller is not on the bus
    LATE = 3  # [s] frames arrive late
    LOST = 4  # [fraction of the frames]
    DOUBLED = 5
    TOO_HOT = 6
    RESET = 7


class Cable:
    """Passes frames between a drive and the bus."""

    def __init__(self, bus: can.BusABC, node: int) -> None:
        self._bus = bus
        self._node = node
        self._random = random.Random(node)
        self._kind = Disturbance.NONE
        self._size = 0.0
        self._until_s = 0.0
        self._coming: deque[Frame] = deque()

    @property
    def disturbance(self) -> Disturbance:
        """The current disturbance."""
        return self._kind if monotonic() < self._until_s else Disturbance.NONE

    def send(self, kind: int, data: bytes) -> None:
        """Send a frame from the drive. A disturbance may drop or double it."""
        for _ in range(self._count_copies()):
            send(self._bus, kind, self._node, data)

    def receive(self, take: Callable[[Frame], None]) -> None:
        """Call `take` with each frame that has arrived, in order. Times are CLOCK_MONOTONIC."""
        late_s = self._size if self.disturbance is Disturbance.LATE else 0.0
        # The kernel stamps frames at arrival, so it does not matter when this process reads them.
        epoch_s = time() - monotonic() - late_s
        for frame in receive(self._bus):
            if (frame.kind, frame.node) == (DISTURB, self._node):
                self._disturb(*SPAN.unpack_from(frame.data))
            else:
                self._coming += [
                    frame._replace(time_s=frame.time_s - epoch_s)
                ] * self._count_copies()
        while self._coming and self._coming[0].time_s <= monotonic():
            take(self._coming.popleft())

    def _disturb(self, kind: int, seconds: float, size: float) -> None:
        """Start a disturbance that replaces the current one and ends after `seconds`."""
        self._kind = next((known for known in Disturbance if known == kind), Disturbance.NONE)
        self._size = size
        self._until_s = monotonic() + seconds

    def _count_copies(self) -> int:
        """Return how many times a frame is delivered: 0 if it is lost."""
        kind = self.disturbance
        if kind in (Disturbance.UNPLUGGED, Disturbance.BUS_OFF):
            return 0
        if kind is Disturbance.LOST and self._random.random() < self._size:
            return 0
        return 2 if kind is Disturbance.DOUBLED else 1
