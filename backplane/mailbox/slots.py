"""The slots of one mailbox: how whole messages get into shared memory and out again.

A message is built in a local record, copied into the slot after the newest one, and published by
one store of its serial in the mailbox's head. A writer killed at any instruction leaves every
published message intact. A reader checks serial and checksum of its copy, so it never returns half
a message.

Memory order: the one writer fills a slot, then stores the head's serial with release; a reader
loads the serial with acquire before it copies the slot, so it sees all of it. A copy may still be
torn by a writer that laps the reader; the checksum detects that. It does not cover the signature,
which is stored after the message and loaded before it, so that a forged message being overwritten
never carries the signature of the true writer. Before a reader concludes from a head that a slot
has not been reused (`keeps`), its copy is complete; in turn the writer fills no slot before the
previous head is stored. Words are aligned to 8 bytes, so they are never torn.

On x86-64 plain loads and stores of aligned words have this order, and Python's are such. Boards
have it from machine code (`rack.boards.run.compiled_mailbox`), which also gives the rare paths in
this folder a `fence`. tests/backplane/mailbox/model.py checks the protocol exhaustively.

The checksum is XXH3, 64 bits, seeded with the checksum of the message before. So one pass over a
message tells a reader whether its copy is whole and undamaged; and the newest checksum stands for
all that was ever written, so that one comparison shows whether two runs are equal
(`history.digest`). Alternatives considered: CRC32 and a chained hash, two passes that took half of
a write; CRC32 alone, seeded likewise: 32 bits are few for a digest, and on 200 bytes it takes five
times as long.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from struct import Struct
from time import monotonic_ns
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, oldest_kept, slot_stride
from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.backplane.message import AnyMessage, copied
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot, Word

CHECKED_FROM = Slot.BASIS * 8
SIGNED_FROM = Slot.CHAIN * 8
"""Offset of the message in a slot, after its time stamp and signature, bytes."""
# Plain integers: an IntEnum member costs a conversion at every use as an index.
_STAMP, _EPOCH, _CHAIN, _CHECK, _BASIS, _SERIAL, _TICK, _VISIBLE = range(8)
_PUT_CONTENT = Struct("@4Q").pack_into  # BASIS to VISIBLE_AT, each stored whole
UNSIGNED = (1 << 64) - 1
"""Mask that turns a word of a slot's head, which is signed, into a checksum."""
EPOCH_BITS = 32
EPOCH_MASK = (1 << EPOCH_BITS) - 1


def claim(epoch: int, pid: int) -> int:
    """Return a writer's signature: the epoch of its claim and, in the upper half, its process
    id.
    """
    return epoch | pid << EPOCH_BITS


def epoch_of(signature: int) -> int:
    """Return the epoch in a writer's signature."""
    return signature & EPOCH_MASK


def pid_of(signature: int) -> int:
    """Return the process in a writer's signature."""
    return signature >> EPOCH_BITS


def message_dtype(fields: tuple[FieldSpec, ...], size: int) -> np.dtype:
    """Return the numpy dtype of a mailbox's message, from its layout."""
    return np.dtype(
        {
            "names": [f.name for f in fields],
            "formats": [_format(f) for f in fields],
            "offsets": [f.offset for f in fields],
            "itemsize": size,
        }
    )


def _format(field: FieldSpec) -> tuple[str | np.dtype, tuple[int, ...]]:
    if not field.fields:
        return field.kind, field.shape
    # A group's own size stands in its kind, "V<bytes>".
    return message_dtype(field.fields, int(field.kind[1:])), field.shape


class Slots:
    """One process's access to the slots of a mailbox: a local `record` and its `message`.

    `record` holds the head's eight words (`words.Slot`), then the message; `words` and `covered`
    are views of its head and of what the checksum covers. `places` are the slots, `heads` their
    words.
    """

    # Of the message in the local record: when it was published, CLOCK_MONOTONIC, and by which
    # writer (see `claim`); the checksum over it and every earlier message of the mailbox; its
    # serial, 0 without a message; the release of the cycle that wrote it, and the tick from which
    # it may be read.
    stamp_ns = Word(Slot.STAMP_NS)
    signature = Word(Slot.EPOCH)
    chain = Word(Slot.CHECK)
    serial = Word(Slot.SERIAL)
    tick = Word(Slot.TICK)
    visible = Word(Slot.VISIBLE_AT)

    def __init__(
        self, segment: Segment, spec: MailboxSpec, record: memoryview | None = None
    ) -> None:
        self.spec = spec
        dtype = message_dtype(spec.fields, spec.size)
        address = segment.map.mailboxes[spec.name]
        stride = slot_stride(spec)
        self.box = segment.box(spec.name)
        self.depth = spec.depth
        self.mask = spec.depth - 1
        self.record = record or memoryview(bytearray(SLOT_HEAD_SIZE + spec.size))
        kind: Any = segment.message_classes.get(spec.name, AnyMessage)
        self.message: AnyMessage = kind(dtype, self.record[SLOT_HEAD_SIZE:])
        first = address + MAILBOX_HEAD_SIZE
        self.places = [
            segment.view(first + i * stride, len(self.record)) for i in range(spec.depth)
        ]
        self.heads = [place[:SLOT_HEAD_SIZE].cast("q") for place in self.places]
        self.words = self.record[:SLOT_HEAD_SIZE].cast("Q")
        self.covered = self.record[CHECKED_FROM:]

    @staticmethod
    def fence() -> None:
        """Keep accesses to memory before and after it apart: nothing on x86-64, where a board puts
        an instruction in its place all the same.
        """

    def resume(self, signature: int) -> None:
        """Continue after the newest published message, as a writer."""
        # Without the sign: a flipped one is no reason to fail.
        head = whole = self.box[Box.HEAD] & (UNSIGNED >> 1)
        # A serial may have been lost: the chain continues from the newest message that is in its
        # slot.
        while whole > max(0, head - self.depth) and not self.holds(whole):
            whole -= 1
        self.serial = head
        self.signature = signature
        self.chain = (
            self.heads[whole & self.mask][_CHECK] & UNSIGNED if whole and self.holds(whole) else 0
        )

    def clear_unpublished(self) -> None:
        """Empty the slots that a dead writer has filled and not published: no reader may take
        them for messages of this writer's that are lost.
        """
        head = self.box[Box.HEAD] & (UNSIGNED >> 1)
        for words in self.heads:
            if words[_SERIAL] > head:
                words[_SERIAL] = 0

    def publish(self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()) -> int:
        """Copy the local message into the next slot, then publish it; return the process of an
        intruder, 0: none.

        An intruder has published since this writer's last message; its message is overwritten.
        `damage`: bits of the message to flip in the slot.
        """
        words = self.words
        box = self.box
        before = words[_SERIAL]
        serial = before + 1
        at = serial & self.mask
        intruder = 0 if box[0] == before else self.heads[at][_EPOCH] >> EPOCH_BITS
        _PUT_CONTENT(self.record, CHECKED_FROM, basis, serial, tick, visible_at)
        words[_CHAIN] = chain = words[_CHECK]
        words[_CHECK] = xxh3(self.covered, chain)
        words[_STAMP] = monotonic_ns()
        # In this order: the previous head, the message, its signature, this head.
        self.fence()
        self.places[at][SIGNED_FROM:] = self.record[SIGNED_FROM:]
        if damage:
            message = self.places[at][SLOT_HEAD_SIZE:]
            for bit in damage:
                message[bit >> 3] ^= 1 << (bit & 7)
        self.fence()
        self.places[at][:SIGNED_FROM] = self.record[:SIGNED_FROM]
        self.fence()
        box[0] = serial
        return intruder

    def lose(self) -> None:
        """Publish a serial without filling its slot."""
        self.serial += 1
        self.fence()
        self.box[0] = self.serial

    def holds(self, serial: int) -> bool:
        """Say whether that serial's slot holds its message, not an older or a newer one."""
        return self.heads[serial & self.mask][_SERIAL] == serial

    def keeps(self, serial: int) -> bool:
        """Say whether that serial's slot has not been reused: a copy made before this call is then
        of that message.
        """
        self.fence()
        return serial >= oldest_kept(self.box[0], self.depth)

    def visible_at(self, serial: int) -> int:
        """Return the tick from which the message in that serial's slot may be read."""
        return self.heads[serial & self.mask][_VISIBLE]

    def load(self, serial: int) -> None:
        """Copy that serial's slot, without any check, into the local record."""
        place = self.places[serial & self.mask]
        # If this is the signature of the message sought, all of that is in the slot.
        self.record[:SIGNED_FROM] = place[:SIGNED_FROM]
        self.fence()
        self.record[SIGNED_FROM:] = place[SIGNED_FROM:]

    def fetch(self, serial: int) -> bool:
        """Copy a message into the local record; False when it is not whole, or another one."""
        self.load(serial)
        return self.serial == serial and self.is_sound

    def between(self, before: int, newest: int) -> Iterator[AnyMessage]:
        """Yield a copy of each good message between two serials, as far as the slots reach back."""
        for serial in range(max(before + 1, newest - self.mask), newest):
            if self.fetch(serial) and self.is_lawful(0):
                yield copied(self.message)

    def copy(self, serial: int) -> bool:
        """Copy that serial's slot as `load` does; False when it was reused meanwhile."""
        self.load(serial)
        return self.keeps(serial)

    @property
    def is_sound(self) -> bool:
        """Whether the message in the local record passes its check."""
        return self.chain == xxh3(self.covered, self.words[_CHAIN])

    def is_lawful(self, known: int) -> bool:
        """Say whether that message comes from the writer that holds the claim, or from an earlier
        holder.

        `known` is the signature of the last lawful message, 0 before the first: epochs only rise.
        """
        signature = self.signature
        holder = self.box[Box.CLAIMANT]
        return signature in (known, holder) or epoch_of(known) < epoch_of(signature) < epoch_of(
            holder
        )
