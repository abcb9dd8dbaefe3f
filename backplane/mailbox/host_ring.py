"""Bounded ring mailboxes from one host board to one bus adapter, not by ticks.

The host board writes at any time. If the ring is full, a write returns False and never waits, and
no message is overwritten that the adapter has not taken. The adapter takes any number of messages
in its cycles and rejects messages that are damaged, forged, or contain values that their type does
not permit. Its position in the ring is in shared memory, so a restarted adapter continues from it.

Alternatives considered: a pipe or a socket per host board (the kernel copies each message twice,
and a dead reader raises in the writer), and protocol time-slice (a host board has no ticks at which
its messages could become visible).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.layout import SPARE_SLOTS, FieldSpec
from rack.backplane.mailbox.mailbox import DoubleBufferWriter
from rack.backplane.mailbox.slots import Slots
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.words import Box


class HostWriter(DoubleBufferWriter):
    """The host board's end of a ring. Opening it claims the mailbox, as for any writer."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._box = self.slots.box

    def send_message(self, tick: int) -> bool:
        """Publish `message`, written at `tick`.

        Returns:
            False if the ring is full. The message is then counted as refused.
        """
        if self._box[Box.HEAD] - self._box[Box.TAKEN] >= self.spec.capacity:
            self._box[Box.REFUSED] += 1
            return False
        return self.write(tick)


class HostReader:
    """The adapter's end of a ring."""

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = spec = segment.layout.find_mailbox(name)
        self._slots = Slots(segment, spec)
        self._box = self._slots.box
        self.refused = 0
        """Number of messages rejected because they were damaged, forged or improper."""
        self.superseded = 0
        """Number of messages that were replaced by a newer one before they were taken."""

    @property
    def waiting_count(self) -> int:
        """Number of waiting messages, at most the number of slots."""
        return min(max(0, self._box[Box.HEAD] - self._box[Box.TAKEN]), self.spec.depth)

    @property
    def full_count(self) -> int:
        """Number of times the writer found the ring full."""
        return self._box[Box.REFUSED]

    @property
    def written_tick(self) -> int:
        """Tick at which the message taken last was written."""
        return self._slots.tick

    def take_oldest(self) -> AnyMessage | None:
        """Take the oldest waiting message. Returns None if it is bad.

        The message is valid until the next call.
        """
        head = self._box[Box.HEAD]
        oldest = self._box[Box.TAKEN] + 1
        # Waiting messages are overwritten only by a writer that breaks the rules.
        serial = max(oldest, head - self.spec.depth + SPARE_SLOTS)
        self.superseded += serial - oldest
        self._box[Box.TAKEN] = serial
        return self._fetch_good(serial)

    def take_newest(self, most: int) -> AnyMessage | None:
        """Take all waiting messages, and return the newest good one.

        Args:
            most: Maximum number of messages to check.

        Returns:
            None if none of these is good.
        """
        waiting = self.waiting_count
        head = self._box[Box.HEAD]
        self._box[Box.TAKEN] = head
        for back in range(min(waiting, most)):
            if (message := self._fetch_good(head - back)) is not None:
                self.superseded += waiting - back - 1
                return message
        return None

    def _fetch_good(self, serial: int) -> AnyMessage | None:
        """Return the message of a serial. A bad one is counted as refused and gives None."""
        slots = self._slots
        if (
            slots.fetch_message(serial)
            and slots.is_lawful(0)
            and is_proper(slots.message.record, self.spec.fields)
        ):
            return slots.message
        self.refused += 1
        return None


def is_proper(record: np.ndarray | np.void, fields: Sequence[FieldSpec]) -> bool:
    """Check whether a message or groups of one contain only permitted values.

    These are finite numbers, lengths within their limits, members of enums, and ASCII texts.
    """
    return all(_is_permitted(record[field.name], field) for field in fields)


def _is_permitted(values: np.ndarray, field: FieldSpec) -> bool:
    """Check the values of one field, which may have any shape."""
    kind = values.dtype.kind
    if kind == "f" and not np.isfinite(values).all():
        return False
    if kind == "S" and not values.tobytes().isascii():
        return False
    if field.values and not np.isin(values, [number for _, number in field.values]).all():
        return False
    if field.length and not _has_length(values, field.length, bool(field.shape)):
        return False
    # In an array of groups, groups of zeros are empty.
    return not field.fields or is_proper(values[values != np.zeros_like(values)], field.fields)


def _has_length(values: np.ndarray, limits: tuple[float, float], is_vector: bool) -> bool:
    """Check the length of vectors along the last axis, or the magnitude of numbers."""
    sizes = np.abs(values)
    if is_vector:
        # Never overflows, unlike a sum of squares.
        sizes = np.hypot.reduce(np.minimum(sizes, 2.0 * limits[1]), axis=-1)
    return bool(((limits[0] <= sizes) & (sizes <= limits[1])).all())
