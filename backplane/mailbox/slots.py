"""The slots of one mailbox: how whole messages get into shared memory and out again.

A message is built in a local record, copied into the slot after the newest one, and published by one store of its
serial in the mailbox's head. A writer killed at any instruction leaves every published message intact. A reader checks
the serial and the CRC of its copy, so it never returns half a message.

Memory order: the one writer fills the slot before it stores the head's serial. On x86-64 other cores see stores in that
order. On weaker machines a reader may see the serial first: its copy then fails the CRC, or holds another serial, and
the read steps back to the message before. Words are aligned to 8 bytes, so they are never torn.

Why a chained hash as well as a CRC: the CRC covers one message and tells a reader, in well under a microsecond, whether
its copy is whole and undamaged. The hash covers this message and the hash before it, so the newest one stands for all
that was ever written: one comparison shows whether two runs are equal (`history.digest`). It is longer than a CRC, so
that no two runs agree by chance, and omits epoch and basis, which are not content. No reader checks it.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from time import monotonic_ns
from zlib import crc32

import numpy as np

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, oldest_kept, slot_stride
from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.backplane.message import Message
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot

CRC_FROM = Slot.EPOCH * 8
CHAIN_FROM = Slot.SERIAL * 8
CHAIN_AT = Slot.CHAIN * 8
# Plain integers: an IntEnum member costs a conversion at every use as an index.
_STAMP, _CRC, _EPOCH, _BASIS, _SERIAL, _TICK, _VISIBLE = range(7)
_CLAIMANT = int(Box.CLAIMANT)
EPOCH_BITS = 32
EPOCH_MASK = (1 << EPOCH_BITS) - 1


def claim(epoch: int, pid: int) -> int:
    """Return a writer's signature: the epoch of its claim and, in the upper half, its process id."""
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

    `record` holds the head's eight words (`words.Slot`), then the message.
    """

    def __init__(self, segment: Segment, spec: MailboxSpec) -> None:
        self.spec = spec
        self.dtype = message_dtype(spec.fields, spec.size)
        address = segment.map.mailboxes[spec.name]
        stride = slot_stride(spec)
        self.box = segment.words[address // 8 : address // 8 + len(Box)]
        self.depth = spec.depth
        self.mask = spec.depth - 1
        self.record = memoryview(bytearray(SLOT_HEAD_SIZE + spec.size))
        self.message = Message(self.dtype, self.record[SLOT_HEAD_SIZE:])
        first = address + MAILBOX_HEAD_SIZE
        self.ring = segment.view(first, spec.depth * stride)
        self._slots = [segment.view(first + i * stride, len(self.record)) for i in range(spec.depth)]
        self._slot_words = [slot[:SLOT_HEAD_SIZE].cast("q") for slot in self._slots]
        self._words = self.record[:SLOT_HEAD_SIZE].cast("q")
        self._crc_part = self.record[CRC_FROM:]
        self._chain_part = self.record[CHAIN_FROM:]
        self._chain = self.record[CHAIN_AT:SLOT_HEAD_SIZE]

    def resume(self, signature: int) -> None:
        """Continue after the newest published message, as a writer."""
        head = whole = self.box[Box.HEAD]
        # A serial may have been lost: the chain continues from the newest message that is in its slot.
        while whole > max(0, head - self.depth) and not self.holds(whole):
            whole -= 1
        self._words[_SERIAL] = head
        self._words[_EPOCH] = signature
        chain = self._slots[whole & self.mask][CHAIN_AT:SLOT_HEAD_SIZE]
        self._chain[:] = bytes(chain) if whole and self.holds(whole) else bytes(8)

    def publish(self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()) -> int:
        """Copy the local message into the next slot, then publish it; return the process of an intruder, 0: none.

        An intruder has published since this writer's last message; its message is overwritten. `damage`: bits of the
        message to flip in the slot.
        """
        words, box = self._words, self.box
        serial = words[_SERIAL] + 1
        intruder = 0 if box[0] == serial - 1 else self._slot_words[serial & self.mask][_EPOCH] >> EPOCH_BITS
        words[_BASIS] = basis
        words[_SERIAL] = serial
        words[_TICK] = tick
        words[_VISIBLE] = visible_at
        # The word still holds the hash of the message before: it is hashed in, then replaced.
        self._chain[:] = blake2b(self._chain_part, digest_size=8).digest()
        words[_CRC] = crc32(self._crc_part)
        words[_STAMP] = monotonic_ns()
        self._slots[serial & self.mask][:] = self.record
        if damage:
            self._flip(serial, damage)
        box[0] = serial
        return intruder

    def lose(self) -> None:
        """Publish a serial without filling its slot."""
        self._words[_SERIAL] += 1
        self.box[0] = self._words[_SERIAL]

    def _flip(self, serial: int, bits: Sequence[int]) -> None:
        message = self._slots[serial & self.mask][SLOT_HEAD_SIZE:]
        for bit in bits:
            message[bit >> 3] ^= 1 << (bit & 7)

    def holds(self, serial: int) -> bool:
        """Say whether that serial's slot holds its message, not an older or a newer one."""
        return self._slot_words[serial & self.mask][_SERIAL] == serial

    def keeps(self, serial: int) -> bool:
        """Say whether that serial's slot has not been reused: a copy made before this call is then of that message."""
        return serial >= oldest_kept(self.box[0], self.depth)

    def heads_and_bodies(self) -> list[tuple[memoryview, memoryview]]:
        """Return each slot's head, as words, and the part of the slot that its CRC covers."""
        return [(head, slot[CRC_FROM:]) for head, slot in zip(self._slot_words, self._slots, strict=True)]

    def visible_at(self, serial: int) -> int:
        """Return the tick from which the message in that serial's slot may be read."""
        return self._slot_words[serial & self.mask][_VISIBLE]

    def fetch(self, serial: int) -> bool:
        """Copy a message into the local record; False when it is not whole, or another one."""
        self.record[:] = self._slots[serial & self.mask]
        return self._words[_SERIAL] == serial and self._words[_CRC] == crc32(self._crc_part)

    def copy(self, serial: int) -> bool:
        """Copy that serial's slot, without any check, into the local record; False when it was reused meanwhile."""
        self.record[:] = self._slots[serial & self.mask]
        return self.keeps(serial)

    @property
    def is_sound(self) -> bool:
        """Whether the message in the local record passes its CRC."""
        return self._words[_CRC] == crc32(self._crc_part)

    @property
    def serial(self) -> int:
        """Serial of the message in the local record; 0: none."""
        return self._words[_SERIAL]

    @property
    def signature(self) -> int:
        """Signature of its writer: see `claim`."""
        return self._words[_EPOCH]

    def is_lawful(self, known: int) -> bool:
        """Say whether that message comes from the writer that holds the claim, or from an earlier holder.

        `known` is the signature of the last lawful message, 0 before the first: epochs only rise.
        """
        signature, holder = self._words[_EPOCH], self.box[_CLAIMANT]
        return signature in (known, holder) or epoch_of(known) < epoch_of(signature) < epoch_of(holder)

    @property
    def tick(self) -> int:
        """Release tick of the cycle that wrote that message."""
        return self._words[_TICK]

    @property
    def visible(self) -> int:
        """Tick from which that message may be read."""
        return self._words[_VISIBLE]

    @property
    def stamp_ns(self) -> int:
        """When that message was published, CLOCK_MONOTONIC."""
        return self._words[_STAMP]

    @property
    def basis(self) -> int:
        """Tick of the oldest information that the message rests on, level by level."""
        return self._words[_BASIS]

    @property
    def chain(self) -> bytes:
        """Running hash over this and every earlier message of the mailbox, 8 bytes."""
        return bytes(self._chain)
