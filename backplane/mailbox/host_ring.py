"""Mailboxes from a host board to its bus adapter, as bounded rings without ticks.

The host board writes at any time and never waits. If the ring is full, the message is refused, so
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
    """Writer of a host board's ring. Like any writer, it claims the mailbox."""

    def send_message(self, tick: int) -> bool:
        """Publish `message`, unless the ring is full.

        Args:
            tick: Current tick, stored with the message.

        Returns:
            False if the ring is full. The message is dropped and counted as refused.
        """
        box = self.slots.box
        if box[Box.HEAD] - box[Box.TAKEN] >= self.spec.capacity:
            box[Box.REFUSED] += 1
            return False
        return self.write(tick)


class HostReader:
    """Reader of a host board's ring, used by the bus adapter."""

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = spec = segment.layout.find_mailbox(name)
        self._slots = Slots(segment, spec)
        self._box = self._slots.box
        self.refused = 0
        """Number of messages rejected: damaged, forged, or with values that are not permitted."""
        self.superseded = 0
        """Number of messages skipped because a newer one was taken or had overwritten them."""

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
        """Tick at which the most recently taken message was written."""
        return self._slots.tick

    def take_oldest(self) -> AnyMessage | None:
        """Take the oldest waiting message. Call this only if a message is waiting.

        Returns:
            The message, which is valid until the next call. None if it was rejected.
        """
        oldest = self._box[Box.TAKEN] + 1
        # If more messages wait than the ring may hold, a faulty writer has overwritten some of
        # them.
        serial = max(oldest, self._box[Box.HEAD] - self.spec.depth + SPARE_SLOTS)
        self.superseded += serial - oldest
        self._box[Box.TAKEN] = serial
        return self._fetch_good(serial)

    def take_newest(self, most: int) -> AnyMessage | None:
        """Take all waiting messages, and return the newest one that is not rejected.

        Args:
            most: Maximum number of messages to check.

        Returns:
            The message, which is valid until the next call. None if no message is waiting, or all
                checked ones were rejected.
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
        """Return the message with the given serial. If it is bad, count it and return None."""
        slots = self._slots
        if (
            slots.fetch_message(serial)
            and slots.is_from_claimant(0)
            and has_permitted_values(slots.message.record, self.spec.fields)
        ):
            return slots.message
        self.refused += 1
        return None


def has_permitted_values(record: np.ndarray | np.void, fields: Sequence[FieldSpec]) -> bool:
    """Check whether all values of a message are permitted.

    Numbers must be finite, norms of vectors within their limits, enum values members of their enum,
    and texts ASCII.

    Args:
        record: The message, or an array with the groups of one of its fields.
        fields: Fields of the message or group.
    """
    return all(_is_permitted(record[field.name], field) for field in fields)


def _is_permitted(values: np.ndarray, field: FieldSpec) -> bool:
    """Check whether all values of one field are permitted. See `has_permitted_values`."""
    kind = values.dtype.kind
    if kind == "f" and not np.isfinite(values).all():
        return False
    if kind == "S" and not values.tobytes().isascii():
        return False
    if field.values and not np.isin(values, [number for _, number in field.values]).all():
        return False
    if field.length and not _is_length_within(values, field.length, bool(field.shape)):
        return False
    # In an array of groups, a group of zeros is an unused entry and is not checked.
    return not field.fields or has_permitted_values(
        values[values != np.zeros_like(values)], field.fields
    )


def _is_length_within(values: np.ndarray, limits: tuple[float, float], is_vector: bool) -> bool:
    """Check whether the norm of each vector, or the magnitude of each number, is within limits.

    Args:
        values: Numbers, or vectors along the last axis.
        limits: Smallest and largest permitted value.
        is_vector: True if `values` contains vectors.
    """
    sizes = np.abs(values)
    if is_vector:
        # `hypot` does not overflow, unlike a sum of squares.
        sizes = np.hypot.reduce(np.minimum(sizes, 2.0 * limits[1]), axis=-1)
    return bool(((limits[0] <= sizes) & (sizes <= limits[1])).all())
