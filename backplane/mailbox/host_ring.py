"""Mailboxes of the host side: a bounded ring from one host board to one bus adapter, not by ticks.

The host board writes at any time. A full ring is an answer, `False`, never a wait: nothing is
overwritten that the adapter has not taken. The adapter takes messages in its own cycles, as many as
it wants, and refuses those that are damaged, forged, or hold what no message of that type may hold.
Its place in the ring is in shared memory, so an adapter that is restarted goes on there.

Alternatives considered: a pipe or a socket per host board (the kernel copies each message twice,
and a dead reader raises in the writer), and protocol time-slice (a host board has no ticks at which
its messages could become visible).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.layout import SPARE, FieldSpec
from rack.backplane.mailbox.mailbox import DoubleBufferWriter
from rack.backplane.mailbox.slots import Slots
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.words import Box


class HostWriter(DoubleBufferWriter):
    """The host board's end of a ring. Opening it claims the mailbox, as any writer does."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._box = self.slots.box

    def send(self, tick: int) -> bool:
        """Publish `message`, written at `tick`; return False, and count it, when the ring is
        full.
        """
        if self._box[Box.HEAD] - self._box[Box.TAKEN] >= self.spec.capacity:
            self._box[Box.REFUSED] += 1
            return False
        return self.write(tick)


class HostReader:
    """The adapter's end of a ring. `taken` and `refused` count messages taken from it, and those
    that were bad.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = spec = segment.layout.mailbox(name)
        self._slots = Slots(segment, spec)
        self._box = self._slots.box
        self.refused = 0
        """Messages refused: damaged, forged, or improper."""
        self.superseded = 0
        """Messages that a newer one overtook before it was taken."""

    @property
    def waiting(self) -> int:
        """Messages that wait, at most the slots of the ring."""
        return min(max(0, self._box[Box.HEAD] - self._box[Box.TAKEN]), self.spec.depth)

    @property
    def full(self) -> int:
        """How often the writer found the ring full."""
        return self._box[Box.REFUSED]

    @property
    def written(self) -> int:
        """Tick at which the message taken last was written."""
        return self._slots.tick

    def take(self) -> AnyMessage | None:
        """Take the oldest message that waits; None if it is bad. Valid until the next call."""
        head = self._box[Box.HEAD]
        oldest = self._box[Box.TAKEN] + 1
        # Only a writer that does not keep to the rules overwrites what waits.
        serial = max(oldest, head - self.spec.depth + SPARE)
        self.superseded += serial - oldest
        self._box[Box.TAKEN] = serial
        return self._fetched(serial)

    def take_newest(self, most: int) -> AnyMessage | None:
        """Take all that wait and return the newest good one, looking at no more than `most`; None:
        there is none.
        """
        waiting = self.waiting
        head = self._box[Box.HEAD]
        self._box[Box.TAKEN] = head
        for back in range(min(waiting, most)):
            if (message := self._fetched(head - back)) is not None:
                self.superseded += waiting - back - 1
                return message
        return None

    def _fetched(self, serial: int) -> AnyMessage | None:
        slots = self._slots
        if (
            slots.fetch(serial)
            and slots.is_lawful(0)
            and is_proper(slots.message.record, self.spec.fields)
        ):
            return slots.message
        self.refused += 1
        return None


def is_proper(record: np.ndarray | np.void, fields: Sequence[FieldSpec]) -> bool:
    """Say whether a message, or some groups of one, hold only what their types permit: finite
    numbers, lengths, members of enums, ASCII.
    """
    return all(_is_permitted(record[field.name], field) for field in fields)


def _is_permitted(values: np.ndarray, field: FieldSpec) -> bool:
    kind = values.dtype.kind
    if kind == "f" and not np.isfinite(values).all():
        return False
    if kind == "S" and not values.tobytes().isascii():
        return False
    if field.values and not np.isin(values, [number for _, number in field.values]).all():
        return False
    if field.length and not _has_length(values, field.length, bool(field.shape)):
        return False
    # In an array of groups, those that are all zero are empty.
    return not field.fields or is_proper(values[values != np.zeros_like(values)], field.fields)


def _has_length(values: np.ndarray, limits: tuple[float, float], is_vector: bool) -> bool:
    sizes = np.abs(values)
    if is_vector:
        # Never overflows, unlike a sum of squares.
        sizes = np.hypot.reduce(np.minimum(sizes, 2.0 * limits[1]), axis=-1)
    return bool(((limits[0] <= sizes) & (sizes <= limits[1])).all())
