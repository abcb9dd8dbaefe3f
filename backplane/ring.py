"""Reading a ring in blocks: for the host side, which must never slow a writer down."""

from __future__ import annotations

from typing import NamedTuple
from zlib import crc32

import numpy as np

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, oldest_kept, slot_stride
from rack.backplane.layout import MailboxSpec
from rack.backplane.segment import Segment
from rack.backplane.slots import CRC_FROM, EPOCH_MASK, epoch_of, message_dtype
from rack.backplane.words import Box, Slot


class Drained(NamedTuple):
    """Rows taken from a ring, oldest first, and how many were overwritten before they could be taken."""

    rows: np.ndarray
    lost: int


class Ring:
    """A ring of fixed records that another process writes; `count` records written stand in `head`."""

    def __init__(self, memory: memoryview, dtype: np.dtype, head: memoryview) -> None:
        # As plain bytes: copied field by field, what lies between fields would be left out, and no CRC fit.
        self._rows, self._dtype = np.frombuffer(memory, dtype=f"V{dtype.itemsize}"), dtype
        self._head = head
        self._depth = len(self._rows)
        self._taken = 0

    @property
    def waiting(self) -> int:
        """Records written and not yet taken."""
        return self._head[0] - self._taken

    def resume(self, taken: int) -> None:
        """Go on after the first `taken` records: another reader had them."""
        self._taken = taken

    def drain(self) -> Drained:
        """Take every record written since the last call."""
        head = self._head[0]
        first = max(self._taken + 1, head - self._depth + 1)
        rows = self._rows[np.arange(first, head + 1) % self._depth].view(self._dtype)
        # What the writer reached while we copied.
        torn = max(0, oldest_kept(self._head[0], self._depth) - first)
        lost = first - self._taken - 1 + min(torn, len(rows))
        self._taken = head
        return Drained(rows[torn:], lost)


class MailboxRing(Ring):
    """The messages of a mailbox as a ring: `words.Slot` fields in lower case, then `message`.

    What no reader takes is left out here too: messages that are lost or damaged, and those of an intruder.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        spec = segment.layout.mailbox(name)
        address, self._stride = segment.map.mailboxes[name], slot_stride(spec)
        self._box = segment.words[address // 8 : address // 8 + len(Box)]
        memory = segment.view(address + MAILBOX_HEAD_SIZE, spec.depth * self._stride)
        super().__init__(memory, row_dtype(spec), self._box[Box.HEAD : Box.HEAD + 1])
        self._covered = slice(CRC_FROM, SLOT_HEAD_SIZE + spec.size)

    def drain(self) -> Drained:
        """Take every good message written since the last call."""
        rows, lost = super().drain()
        if not len(rows):
            return Drained(rows, lost)
        serials = np.arange(self._taken - len(rows), self._taken) + 1
        holder, signatures = self._box[Box.CLAIMANT], rows["epoch"]
        lawful = (signatures == holder) | ((signatures & EPOCH_MASK) < epoch_of(holder))
        if not lawful[-1]:
            # Its writer does not know of it, and will write its own message in that place.
            self._taken -= 1
        covered = rows.view(np.uint8).reshape(len(rows), self._stride)[:, self._covered]
        crcs = (crc32(part.tobytes()) for part in covered)
        good = lawful & (np.fromiter(crcs, np.int64, len(rows)) == rows["crc"]) & (rows["serial"] == serials)
        return Drained(rows if good.all() else rows[good], lost)


def mailbox_ring(segment: Segment, name: str) -> Ring:
    """Return the ring of a mailbox's messages. Raises `KeyError`."""
    return MailboxRing(segment, name)


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
