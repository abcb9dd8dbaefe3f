"""Protocol lock: the paper's pseudo-code, `lock; read; unlock`, made safe against dead holders.

A semaphore whose holder was killed stays down for good, and whose it is cannot be read off it. So the
semaphore is what one waits on, within a bound; the critical section belongs to who has the kernel's lock on
the mailbox, which ends with its process. An access that its bound cut off is a bus error: a verdict, never
a hang.
"""

from __future__ import annotations

from contextlib import suppress
from types import TracebackType

import posix_ipc

from backplane.byte_lock import ByteLock
from backplane.mailbox import Reader, Reading, Writer
from backplane.segment import Segment
from backplane.semaphores import lock_semaphore
from backplane.words import Box

WAIT_S = 0.002
"""Bound of one wait: an access is a microsecond or two, a holder that loses its core some hundred."""


class MailboxLock:
    """Mutual exclusion on one mailbox, with a bounded wait; as a context it tells whether it was obtained."""

    def __init__(self, segment: Segment, name: str, wait_s: float = WAIT_S) -> None:
        self._semaphore = lock_semaphore(segment.rack, name)
        self._owner = ByteLock(segment, segment.map.mailboxes[name] + 8 * Box.OWNER)
        self._wait_s = wait_s
        self._is_owner = False

    def acquire(self) -> bool:
        """Take the lock within its bound; False when its holder lives and keeps it."""
        # A wait that has passed its bound may have been for a dead holder: the owner's lock is free then. And
        # who comes through the semaphore behind a holder that was overtaken between its two steps is no owner.
        with suppress(posix_ipc.BusyError):
            self._semaphore.acquire(self._wait_s)
        self._is_owner = self._owner.take()
        return self._is_owner

    def release(self) -> None:
        """Give the lock back."""
        self._is_owner = False
        self._owner.give_back()
        self._semaphore.release()

    def close(self) -> None:
        """Give the descriptor back."""
        self._owner.close()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._is_owner:
            self.release()


class LockWriter(Writer):
    """A writer that publishes inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._lock = MailboxLock(segment, name)

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`; return False when its time has passed or the lock's bound cut it off."""
        with self._lock as locked:
            if not locked:
                self.bus_errors += 1
                return False
            self._slots.publish(tick, tick if now is None else now, tick if basis is None else basis)
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
        with self._lock as locked:
            return self._newest() if locked else self._cut_off()
