"""Claims: which process may write a mailbox, and since which epoch.

A claim has two parts. The kernel's lock on an address of the mailbox shows that the process of the
writer lives, and refuses a second writer. A word in the head of the mailbox names process and
epoch, and readers compare it with the signature of each message. A standby that takes over from a
process that is only stopped begins an epoch without the lock, and takes the lock when that process
has ended.
"""

from __future__ import annotations

import os
from weakref import WeakSet

from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.slots import Slots, build_signature, get_epoch
from rack.backplane.segment import Segment
from rack.backplane.words import Box


class MailboxClaim:
    """The claim of one writer on its mailbox.

    Attributes:
        is_taken: True from the beginning of an epoch until `release`.
        is_locked: True if this process holds the kernel's lock.
    """

    def __init__(self, segment: Segment, slots: Slots) -> None:
        name = slots.spec.name
        self._name = name
        self._slots = slots
        # The claim is in the segment, even if the slots publish to another head.
        self._box = segment.get_box(name)
        self._lock = ByteLock(segment.fd, segment.map.mailboxes[name] + 8 * Box.CLAIM)
        self.is_taken = False
        self.is_locked = False
        _CLAIMS.add(self)

    def take(self) -> int:
        """Claim the mailbox in a new epoch.

        Returns:
            Serial of the newest message of the previous writer.

        Raises:
            MailboxError: The mailbox has another writer.
        """
        if not self.try_lock():
            self._lock.close()
            raise MailboxError(
                f"mailbox '{self._name}' already has a writer (process {self._box[Box.WRITER_PID]})"
            )
        head = self._box[Box.HEAD]
        self.begin_epoch(head)
        return head

    def try_lock(self) -> bool:
        """Take the kernel's lock, unless another process holds it."""
        self.is_locked = self.is_locked or self._lock.take()
        return self.is_locked

    def begin_epoch(self, head: int) -> None:
        """Enter this process in the head of the mailbox as its writer.

        Args:
            head: Serial of the newest message of the previous writer.
        """
        box = self._box
        # A process that was killed before it stored its claim has used no epoch.
        epoch = get_epoch(box[Box.CLAIMANT] + 1)
        box[Box.BEGUN + epoch % Box.EPOCHS] = head
        # A reader that finds the new claim must find the word that belongs to it.
        self._slots.fence()
        box[Box.WRITER_PID] = os.getpid()
        box[Box.EPOCH] = epoch
        # Epoch and process are stored in one word, so that no reader sees half a claim.
        box[Box.CLAIMANT] = signature = build_signature(epoch, os.getpid())
        # The word of the checksum depends on the signature: see `Slots.chain`.
        chain = self._slots.chain
        self._slots.signature = signature
        self._slots.chain = chain
        self.is_taken = True

    def set_begun(self, head: int) -> None:
        """Correct the serial of the newest message before the epoch of this claim."""
        self._box[Box.BEGUN + get_epoch(self._slots.signature) % Box.EPOCHS] = head

    @property
    def is_valid(self) -> bool:
        """True if no other process has claimed the mailbox since this one did."""
        return self.is_taken and self._box[Box.CLAIMANT] == self._slots.signature

    def release(self) -> None:
        """Stop writing, because a standby has taken over the mailbox."""
        self.is_taken = self.is_locked = False
        self._lock.release()

    def close(self) -> None:
        """Release the lock, and keep the claim out of `reclaim_mailboxes`."""
        _CLAIMS.discard(self)
        self._lock.close()


_CLAIMS: WeakSet[MailboxClaim] = WeakSet()
"""Claims of this process."""


def reclaim_mailboxes() -> None:
    """Claim all mailboxes of this process again, after it was switched to another segment."""
    for claim in _CLAIMS:
        if claim.is_taken:
            claim.is_locked = False
            claim.take()
