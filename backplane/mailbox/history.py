"""Access to the messages of a mailbox for recorders and tools, and the digest of a run.

The digest is a hash over everything that the tasks wrote: ticks and values, but no wall-clock
times. It is computed from the newest chained checksum of each mailbox, which covers all earlier
messages. The digest is therefore complete even if a recorder has lost messages, and a restarted
writer continues the chain. Messages that become visible after the last tick do not count: they are
never read, and whether they are written before the run ends depends on timing. The mailboxes of
host boards do not count either, because they are not written at ticks.
"""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, compute_slot_stride
from rack.backplane.layout import MailboxSpec
from rack.backplane.mailbox.slots import (
    CHECKED_FROM,
    EPOCH_MASK,
    Slots,
    build_message_dtype,
    get_epoch,
)
from rack.backplane.ring import NewRows, Ring
from rack.backplane.segment import Segment
from rack.backplane.words import Box

HEAD_WORDS = {
    "stamp_ns": "i8",
    "epoch": "i8",
    "chain": "u8",
    "check": "u8",
    "basis": "i8",
    "serial": "i8",
    "tick": "i8",
    "visible_at": "i8",
}
"""Words of `words.Slot` in their order, with their types."""


class MailboxRing(Ring):
    """Reader of a mailbox's messages in blocks, as rows with fields `HEAD_WORDS` and `message`.

    Messages that every reader rejects are omitted: lost, damaged or forged ones.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        spec = segment.layout.find_mailbox(name)
        self._stride = compute_slot_stride(spec)
        self._box = segment.get_box(name)
        first = segment.map.mailboxes[name] + MAILBOX_HEAD_SIZE
        memory = segment.get_bytes(first, spec.depth * self._stride)
        head = self._box[Box.HEAD : Box.HEAD + 1]
        super().__init__(memory, build_row_dtype(spec), head, self._box[Box.FIRST])
        self._covered = slice(CHECKED_FROM, SLOT_HEAD_SIZE + spec.size)

    def read_new_rows(self) -> NewRows:
        """Read the messages written since the last call, except lost, damaged or forged ones."""
        rows, lost = super().read_new_rows()
        if not len(rows):
            return NewRows(rows, lost)
        serials = np.arange(self.taken - len(rows), self.taken) + 1
        holder, begun = self._read_claim()
        signatures = rows["epoch"]
        epochs = signatures & EPOCH_MASK
        newest = get_epoch(holder)
        # As in `Slots.is_from_claimant`.
        following = np.maximum(epochs + 1, newest - Box.EPOCHS + 1) % Box.EPOCHS
        lawful = (signatures == holder) | ((epochs < newest) & (serials <= begun[following]))
        if not lawful[-1]:
            # The newest message is forged. The true writer will overwrite it with its next message,
            # which has the same serial, so read this row again at the next call.
            self.taken -= 1
        covered = rows.view(np.uint8).reshape(len(rows), self._stride)[:, self._covered]
        checks = (
            xxh3(content.tobytes(), chain)
            for content, chain in zip(covered, rows["chain"].tolist(), strict=True)
        )
        good = (
            lawful
            & (np.fromiter(checks, np.uint64, len(rows)) == rows["check"] ^ epochs.astype("u8"))
            & (rows["serial"] == serials)
        )
        if not good.all():
            rows = rows[good]
        return NewRows(rows, lost)

    def _read_claim(self) -> tuple[int, np.ndarray]:
        """Return the signature of the writer, and the words `Box.BEGUN` that belong to it."""
        while True:
            holder = self._box[Box.CLAIMANT]
            begun = np.array(self._box[Box.BEGUN : Box.BEGUN + Box.EPOCHS])
            if self._box[Box.CLAIMANT] == holder:
                return holder, begun


def build_row_dtype(spec: MailboxSpec) -> np.dtype:
    """Return the dtype of a row of `MailboxRing`, which spans a whole slot with its padding."""
    message = build_message_dtype(spec.fields, spec.size)
    return np.dtype(
        {
            "names": [*HEAD_WORDS, "message"],
            "formats": [*HEAD_WORDS.values(), message],
            "offsets": range(0, SLOT_HEAD_SIZE + 8, 8),
            "itemsize": compute_slot_stride(spec),
        }
    )


def find_chains(segment: Segment, until: int) -> dict[str, tuple[int, int]]:
    """Return serial and chained checksum of the newest good message of each mailbox.

    Mailboxes written by host boards are left out.

    Args:
        segment: Memory of the rack.
        until: Messages that became visible at this tick or later are ignored.

    Returns:
        A dictionary from mailbox to the pair. Both values are 0 if there is no such message.
    """
    chain_by_mailbox = {}
    for spec in segment.layout.timed:
        slots = Slots(segment, spec)
        serial = head = slots.box[Box.HEAD]
        oldest = max(0, head - slots.depth)
        # A lost, damaged or forged message has no valid chain, so use an earlier message.
        while serial > oldest and not (
            slots.read_visible_tick(serial) < until
            and slots.fetch_message(serial)
            and slots.is_from_claimant(0)
        ):
            serial -= 1
        chain_by_mailbox[spec.name] = serial, slots.chain if serial > oldest else 0
    return chain_by_mailbox


def compute_digest(segment: Segment, until: int) -> str:
    """Compute the digest of a run, a text of 32 hexadecimal digits.

    Args:
        segment: Memory of the rack.
        until: Messages that became visible at this tick or later are ignored.
    """
    total = blake2b(digest_size=16)
    for name, (serial, chain) in sorted(find_chains(segment, until).items()):
        total.update(f"{name} {serial} {chain} ".encode())
    return total.hexdigest()
