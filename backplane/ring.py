"""Reading a ring in blocks: for the host side, which must never slow a writer down."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from backplane.address_map import MAILBOX_HEAD_SIZE, oldest_kept, slot_stride
from backplane.layout import MailboxSpec
from backplane.segment import Segment
from backplane.slots import message_dtype
from backplane.words import Box, Slot


class Drained(NamedTuple):
    """Rows taken from a ring, oldest first, and how many were overwritten before they could be taken."""

    rows: np.ndarray
    lost: int


class Ring:
    """A ring of fixed records that another process writes; `count` records written stand in `head`."""

    def __init__(self, memory: memoryview, dtype: np.dtype, head: memoryview) -> None:
        self._rows = np.frombuffer(memory, dtype=dtype)
        self._head = head
        self._depth = len(self._rows)
        self._taken = 0

    @property
    def waiting(self) -> int:
        """Records written and not yet taken."""
        return self._head[0] - self._taken

    def resume(self, taken: int) -> None:
        """Go on behind the first `taken` records: another reader had them."""
        self._taken = taken

    def drain(self) -> Drained:
        """Take every record written since the last call."""
        head = self._head[0]
        first = max(self._taken + 1, head - self._depth + 1)
        rows = self._rows[np.arange(first, head + 1) % self._depth]
        # What the writer reached while we copied.
        torn = max(0, oldest_kept(self._head[0], self._depth) - first)
        lost = first - self._taken - 1 + min(torn, len(rows))
        self._taken = head
        return Drained(rows[torn:], lost)


def mailbox_ring(segment: Segment, name: str) -> Ring:
    """Return the messages of a mailbox as a ring: `words.Slot` fields in lower case, then `message`."""
    spec = segment.layout.mailbox(name)
    stride, dtype = slot_stride(spec), row_dtype(spec)
    address = segment.map.mailboxes[name]
    head = segment.words[address // 8 + Box.HEAD : address // 8 + Box.HEAD + 1]
    return Ring(segment.view(address + MAILBOX_HEAD_SIZE, spec.depth * stride), dtype, head)


def row_dtype(spec: MailboxSpec) -> np.dtype:
    """Return the type of one row of a mailbox's ring, padding and all."""
    return np.dtype(
        {
            "names": [word.name.lower() for word in Slot] + ["message"],
            "formats": ["i8"] * len(Slot) + [message_dtype(spec.fields, spec.size)],
            "offsets": [8 * word for word in Slot] + [8 * len(Slot)],
            "itemsize": slot_stride(spec),
        }
    )
