"""Slots of one mailbox, the places in shared memory into which its messages are copied.

A message is built in a local record, copied into the slot after the newest one, and published by
storing its serial in the mailbox's head. A writer killed at any instruction leaves every published
message intact. A reader checks serial and checksum of its copy, so it never returns half a message.

Memory order: the only writer fills a slot and then stores the head's serial with release. A reader
loads the serial with acquire before it copies the slot, so it sees all of the slot. A copy may
still be torn by a writer that laps the reader, which the checksum detects. The checksum does not
cover the signature. The signature is stored after the message and loaded before it, so that a
forged message that is being overwritten never carries the signature of the true writer. A reader
completes its copy before it loads the head to check that the slot has not been reused
(`is_intact`), and the writer fills no slot before it has stored the head for the previous one.
Words are aligned to 8 bytes, so they are never torn.

On x86-64 plain loads and stores of aligned words have this order, and Python uses such loads and
stores. Boards get the order from machine code (`rack.boards.run.compiled_mailbox`), which also
provides a `fence` for the rare paths in this folder. tests/backplane/mailbox/model.py checks the
protocol exhaustively.

The checksum is XXH3 with 64 bits, seeded with the checksum of the previous message. One pass over a
message shows a reader whether its copy is complete and undamaged. The newest checksum covers all
messages that were ever written, so a comparison of these checksums shows whether two runs are equal
(`history.compute_digest`). Alternatives considered: CRC32 and a chained hash (the two passes took
half of the time of a write), and a seeded CRC32 alone (32 bits are few for a digest, and it takes
five times as long on 200 bytes).
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from time import monotonic_ns
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.address_map import (
    MAILBOX_HEAD_SIZE,
    SLOT_HEAD_SIZE,
    compute_oldest_intact,
    compute_slot_stride,
)
from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot, Word

CHECKED_FROM = Slot.BASIS * 8
SIGNED_FROM = Slot.CHAIN * 8
"""Byte offset in a slot of the words after time stamp and signature."""
# Module constants are faster than class attributes.
_STAMP, _EPOCH, _CHAIN, _CHECK, _BASIS, _SERIAL, _TICK, _VISIBLE = range(8)
_PUT_CONTENT = Struct("@4Q").pack_into  # BASIS to VISIBLE_AT, each stored whole
UNSIGNED = (1 << 64) - 1
"""Mask that turns a signed word of a slot's head into a checksum."""
EPOCH_BITS = 32
EPOCH_MASK = (1 << EPOCH_BITS) - 1


def build_signature(epoch: int, pid: int) -> int:
    """Build a writer's signature from the epoch of its claim and its process id.

    The process id is in the upper half.
    """
    return epoch | pid << EPOCH_BITS


def get_epoch(signature: int) -> int:
    """Return the epoch in a writer's signature."""
    return signature & EPOCH_MASK


def get_pid(signature: int) -> int:
    """Return the process id in a writer's signature."""
    return signature >> EPOCH_BITS


def build_message_dtype(fields: tuple[FieldSpec, ...], size: int) -> np.dtype:
    """Return the numpy dtype of a message.

    Args:
        fields: Fields of the message.
        size: Size of the message in bytes.
    """
    return np.dtype(
        {
            "names": [f.name for f in fields],
            "formats": [
                # The kind of a group, "V<bytes>", contains its size.
                (build_message_dtype(f.fields, int(f.kind[1:])) if f.fields else f.kind, f.shape)
                for f in fields
            ],
            "offsets": [f.offset for f in fields],
            "itemsize": size,
        }
    )


class Slots:
    """One process's access to the slots of a mailbox.

    Attributes:
        box: Head of the mailbox, with the words of `words.Box`.
        depth: Number of slots.
        mask: `serial & mask` is the index of the slot for a serial.
        record: The local record, a copy of one slot: the eight words of its head (`words.Slot`)
            and the message.
        message: The message in the local record, also called the local message.
        words: The eight words of the local record.
        covered: Part of the local record that the checksum covers.
        places: The slots in shared memory, as bytes.
        heads: The eight words of each slot in shared memory.
    """

    # Words of the local record: time of publication (CLOCK_MONOTONIC), signature of the writer
    # (see `build_signature`), serial (0 without a message), release tick of the writing cycle, and
    # tick from which the message is visible.
    stamp_ns = Word(Slot.STAMP_NS)
    signature = Word(Slot.EPOCH)
    serial = Word(Slot.SERIAL)
    tick = Word(Slot.TICK)
    visible = Word(Slot.VISIBLE_AT)

    def __init__(
        self, segment: Segment, spec: MailboxSpec, record: memoryview | None = None
    ) -> None:
        self.spec = spec
        dtype = build_message_dtype(spec.fields, spec.size)
        stride = compute_slot_stride(spec)
        self.box = segment.get_box(spec.name)
        self.depth = spec.depth
        self.mask = spec.depth - 1
        self.record = record or memoryview(bytearray(SLOT_HEAD_SIZE + spec.size))
        kind: Any = segment.message_classes.get(spec.name, AnyMessage)
        self.message: AnyMessage = kind(dtype, self.record[SLOT_HEAD_SIZE:])
        first = segment.map.mailboxes[spec.name] + MAILBOX_HEAD_SIZE
        self.places = [
            segment.get_bytes(first + i * stride, len(self.record)) for i in range(spec.depth)
        ]
        self.heads = [place[:SLOT_HEAD_SIZE].cast("q") for place in self.places]
        self.words = self.record[:SLOT_HEAD_SIZE].cast("Q")
        self.covered = self.record[CHECKED_FROM:]

    @property
    def chain(self) -> int:
        """Checksum over the message in the local record and every earlier message of the mailbox.

        The word in the record is the checksum combined with the epoch of the writer's claim. After
        a standby has taken over, the message of one writer with the signature of the other fails
        the check, whereas the checksum itself is the same in equal runs.
        """
        return self.words[_CHECK] ^ (self.words[_EPOCH] & EPOCH_MASK)

    @chain.setter
    def chain(self, value: int) -> None:
        self.words[_CHECK] = value ^ (self.words[_EPOCH] & EPOCH_MASK)

    @staticmethod
    def fence() -> None:
        """Prevent memory accesses from being reordered across this call.

        Python needs no instruction for this on x86-64. Boards replace this function with a compiled
        memory fence.
        """

    def resume_writing(self, signature: int, head: int) -> None:
        """Set the local record so that a writer continues after the newest published message.

        Args:
            signature: Signature of the writer.
            head: Serial of the newest message.
        """
        # Ignore the sign, so that a flipped sign bit does not make a writer fail.
        self.serial = head = head & (UNSIGNED >> 1)
        self.signature = signature
        # The newest serial may have no message. The chain of checksums continues from the newest
        # message that is in its slot.
        self.chain = 0
        for serial in range(head, max(0, head - self.depth - 1), -1):
            if self.has_message(serial):
                words = self.heads[serial & self.mask]
                self.chain = (words[_CHECK] & UNSIGNED) ^ (words[_EPOCH] & EPOCH_MASK)
                break

    def find_newest(self, claimant: int) -> int:
        """Return the serial of the newest message that a writer has published.

        The head differs from it if an earlier writer that was stopped has published since.

        Args:
            claimant: Signature of the writer. Its epoch is the newest, or the one before.
        """
        begun = self.box[Box.BEGUN + get_epoch(claimant) % Box.EPOCHS]
        # A stopped writer may store this word at any time, so load it once.
        head = max(self.box[Box.HEAD], begun)
        own = (words[_SERIAL] for words in self.heads if words[_EPOCH] == claimant)
        newest = max(own, default=begun)
        # The slot of a lost message still contains an older one, or was never filled. A slot that
        # was cleared has a signature.
        slot = self.heads[head & self.mask]
        is_cleared = slot[_SERIAL] == 0 and slot[_EPOCH] != 0
        is_lost = slot[_SERIAL] == head - self.depth and not is_cleared
        is_set_back = newest > head + 1
        is_set_ahead = newest < head and not is_lost
        return newest if is_set_back or is_set_ahead else head

    def clear_unpublished(self, head: int) -> None:
        """Clear the serials of slots that a dead writer has filled but not published.

        Otherwise readers could mistake them for lost messages of the new writer.

        Args:
            head: Serial of the newest message.
        """
        head &= UNSIGNED >> 1
        for words in self.heads:
            if words[_SERIAL] > head:
                words[_SERIAL] = 0

    def publish_message(
        self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()
    ) -> int:
        """Copy the local message into the next slot and publish it.

        An intruder is a process that has published since this writer's last message. Its message is
        overwritten.

        Args:
            tick: Release tick of the cycle that writes.
            visible_at: Tick from which the message is visible.
            basis: Tick of the oldest information on which the message depends.
            damage: Bits of the message to flip in the slot, to inject a fault.

        Returns:
            Process id of an intruder, 0 for none.
        """
        words = self.words
        box = self.box
        before = words[_SERIAL]
        serial = before + 1
        at = serial & self.mask
        intruder = 0 if box[0] == before else self.heads[at][_EPOCH] >> EPOCH_BITS
        _PUT_CONTENT(self.record, CHECKED_FROM, basis, serial, tick, visible_at)
        epoch = words[_EPOCH] & EPOCH_MASK
        words[_CHAIN] = chain = words[_CHECK] ^ epoch
        words[_CHECK] = xxh3(self.covered, chain) ^ epoch
        words[_STAMP] = monotonic_ns()
        # The order of stores is: the previous head, the message, its signature, this head.
        self.fence()
        self.places[at][SIGNED_FROM:] = self.record[SIGNED_FROM:]
        for bit in damage:
            self.places[at][SLOT_HEAD_SIZE + (bit >> 3)] ^= 1 << (bit & 7)
        self.fence()
        self.places[at][:SIGNED_FROM] = self.record[:SIGNED_FROM]
        self.fence()
        box[0] = serial
        return intruder

    def publish_gap(self) -> None:
        """Publish the next serial without filling its slot."""
        self.serial += 1
        self.fence()
        self.box[0] = self.serial

    def has_message(self, serial: int) -> bool:
        """Check whether the slot of a serial contains its message, not an older or newer one."""
        return self.heads[serial & self.mask][_SERIAL] == serial

    def is_intact(self, serial: int) -> bool:
        """Check that the slot of a serial has not been reused for a newer message.

        If this returns True, a copy of the slot made before the call contains no newer message.
        """
        self.fence()
        return serial >= compute_oldest_intact(self.box[0], self.depth)

    def read_visible_tick(self, serial: int) -> int:
        """Return the tick from which the message in the slot of a serial is visible."""
        return self.heads[serial & self.mask][_VISIBLE]

    def load_slot(self, serial: int) -> None:
        """Copy the slot of a serial into the local record, without any check."""
        place = self.places[serial & self.mask]
        # Load the signature first. If it belongs to the wanted message, the slot already
        # contains all of the message.
        self.record[:SIGNED_FROM] = place[:SIGNED_FROM]
        self.fence()
        self.record[SIGNED_FROM:] = place[SIGNED_FROM:]
        # The claim is loaded after that.
        self.fence()

    def fetch_message(self, serial: int) -> bool:
        """Copy the message with the given serial into the local record.

        Returns:
            False if the copy is damaged or incomplete, or the slot contains another message.
        """
        self.load_slot(serial)
        return self.serial == serial and self.passes_check

    def copy_slot(self, serial: int) -> bool:
        """Copy the slot of a serial into the local record, and check that it was not reused.

        Returns:
            False if the slot was reused during the copy.
        """
        self.load_slot(serial)
        return self.is_intact(serial)

    @property
    def passes_check(self) -> bool:
        """True if the checksum of the message in the local record is correct."""
        return self.chain == xxh3(self.covered, self.words[_CHAIN])

    def is_from_claimant(self, known: int) -> bool:
        """Check whether the writer of the local message held the claim on the mailbox.

        A message of an earlier writer was published before the next epoch began. A writer that was
        stopped, and whose mailbox a standby has taken over, may store one more message. Its serial
        is greater.

        Args:
            known: Signature of the last message accepted by the caller, 0 for none. Messages from
                earlier epochs than this one are rejected.
        """
        signature = self.signature
        holder = self.box[Box.CLAIMANT]
        if signature == holder:
            return True
        self.fence()
        epoch = get_epoch(signature)
        newest = get_epoch(holder)
        if signature != known and not get_epoch(known) < epoch < newest:
            return False
        # Epochs that began too long ago have no word any more. The oldest word is a bound for them.
        following = max(epoch + 1, newest - Box.EPOCHS + 1)
        begun = self.box[Box.BEGUN + following % Box.EPOCHS]
        self.fence()
        if self.box[Box.CLAIMANT] != holder:
            # Later claims may have replaced the word.
            return self.is_from_claimant(known)
        return epoch < newest and self.serial <= begun
