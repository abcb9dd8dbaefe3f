"""Protocol lock: the paper's pseudo-code, `lock; read; unlock`, made safe against dead holders.

A semaphore held by a killed process stays held for good, so every wait is bounded, and a waiter whose
bound has passed takes the lock over when its holder is dead. An access that its bound cut off is a bus
error: a verdict, never a hang.
"""

from __future__ import annotations

import os
from types import TracebackType

import posix_ipc

from backplane.byte_lock import ByteLock
from backplane.mailbox import Reader, Reading, Verdict, Writer
from backplane.process import is_alive
from backplane.segment import Segment
from backplane.semaphores import lock_semaphore
from backplane.words import Box

WAIT_S = 0.002
"""Bound of one wait: an access is a microsecond or two, a holder that loses its core some hundred."""


class MailboxLock:
    """Mutual exclusion on one mailbox, on a `posix_ipc.Semaphore`."""

    def __init__(self, segment: Segment, name: str, wait_s: float = WAIT_S) -> None:
        self._semaphore = lock_semaphore(segment.rack, name)
        address = segment.map.mailboxes[name] // 8
        self._holder = segment.words[address + Box.LOCK_HOLDER : address + Box.LOCK_HOLDER + 1]
        self._succession = ByteLock(segment, address * 8 + Box.LOCK_HOLDER)
        self._wait_s = wait_s
        self._pid = os.getpid()
        self._orphaned = False

    def acquire(self) -> bool:
        """Take the lock within its bound; False when its holder lives and keeps it."""
        try:
            self._semaphore.acquire(self._wait_s)
        except posix_ipc.BusyError:
            return self._take_over()
        self._holder[0] = self._pid
        self._orphaned = False
        return True

    def _take_over(self) -> bool:
        """Take the lock from a dead holder: the semaphore stays down, only the holder changes.

        A holder killed between the semaphore and its pid left no name: the lock counts as orphaned when
        two waits in a row, each a thousand times longer than an access, found nobody.
        """
        # Of two waiters that see the same dead holder one goes in; the other finds a live one.
        if not self._succession.take():
            return False
        holder = self._holder[0]
        dead = self._orphaned if holder == 0 else not is_alive(holder)
        self._orphaned = holder == 0 and not dead
        if dead:
            self._holder[0] = self._pid
        self._succession.give_back()
        return dead

    def release(self) -> None:
        """Give the lock back."""
        self._holder[0] = 0
        self._semaphore.release()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._holder[0] == self._pid:
            self.release()


class LockWriter(Writer):
    """A writer that publishes inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._lock = MailboxLock(segment, name)
        self.bus_errors = 0

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`; return False when its time has passed or the lock's bound cut it off."""
        with self._lock as locked:
            if not locked:
                self.bus_errors += 1
                return False
            self._slots.publish(tick, tick if now is None else now, tick if basis is None else basis)
        return now is None or now < tick + self.spec.delay


class LockReader(Reader):
    """A reader that copies inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._lock = MailboxLock(segment, name)

    def read(self, tick: int) -> Reading:
        """Return the newest message, or BUS_ERROR with the last good one when the bound cut the wait off."""
        self.accesses += 1
        with self._lock as locked:
            if locked:
                return self._newest()
        self.bus_errors += 1
        return self._readings[Verdict.BUS_ERROR]

