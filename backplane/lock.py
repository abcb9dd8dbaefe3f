"""Protocol lock: the paper's pseudo-code, `lock; read; unlock`, made safe against dead holders.

A semaphore whose holder was killed stays down for good, and whose it is cannot be read off it. So the
semaphore is what one waits on, within a bound; the critical section belongs to who has the kernel's lock on
the mailbox, which ends with its process. An access that its bound cut off is a bus error: a verdict, never
a hang.
"""

from __future__ import annotations

import posix_ipc

from backplane.byte_lock import ByteLock
from backplane.mailbox import Reader, Reading, Writer
from backplane.segment import Segment
from backplane.semaphores import lock_semaphore
from backplane.words import Box

WAIT_S = 0.002
"""Bound of one wait: an access is a microsecond or two, a holder that loses its core some hundred."""


class MailboxLock:
    """Mutual exclusion on one mailbox, with a bounded wait."""

    def __init__(self, segment: Segment, name: str, wait_s: float = WAIT_S) -> None:
        self._semaphore = lock_semaphore(segment.rack, name)
        self._owner = ByteLock(segment, segment.map.mailboxes[name] + 8 * Box.OWNER)
        self._wait_s = wait_s

    def acquire(self) -> bool:
        """Take the lock within its bound; False when its holder lives and keeps it."""
        try:
            self._semaphore.acquire(self._wait_s)
        except posix_ipc.BusyError:
            # Free when whoever took the semaphore is dead. Of several waiters one gets it.
            return self._owner.take()
        # Not free when a waiter whose bound had passed came between the two steps: it is the owner then.
        return self._owner.take()

    def release(self) -> None:
        """Give the lock back. Only its owner may."""
        self._owner.give_back()
        self._semaphore.release()

    def close(self) -> None:
        """Give the descriptor back."""
        self._owner.close()


class LockWriter(Writer):
    """A writer that publishes inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._lock = MailboxLock(segment, name)

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`; return False when its time has passed or the lock's bound cut it off."""
        if not self._lock.acquire():
            self.bus_errors += 1
            return False
        try:
            self._slots.publish(tick, tick if now is None else now, tick if basis is None else basis)
        finally:
            self._lock.release()
        return now is None or now < tick + self.spec.delay

    def close(self) -> None:
        """Give the claim back."""
        self._lock.close()
        super().close()


class LockReader(Reader):
    """A reader that copies inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._lock = MailboxLock(segment, name)

    def read(self, tick: int) -> Reading:
        """Return the newest message, or BUS_ERROR with the last good one when the bound cut the wait off."""
        self.accesses += 1
        if not self._lock.acquire():
            return self._cut_off()
        try:
            return self._newest()
        finally:
            self._lock.release()
