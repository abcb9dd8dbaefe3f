"""The mailbox protocols by name, and protocol lock: the paper's `lock; read; unlock`.

Protocol lock survives the death of a process inside the critical section. A semaphore whose holder
was killed is never posted again, and does not show who held it. Processes therefore wait on the
semaphore only for a bounded time, and the critical section belongs to the process that holds the
kernel's lock on the mailbox, which the kernel releases when that process ends. An access that times
out gives verdict BUS_ERROR and never hangs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from rack.backplane.byte_lock import ByteLock
from rack.backplane.layout import Protocol
from rack.backplane.mailbox.interrupt import BoardInbox, InterruptReader, InterruptWriter
from rack.backplane.mailbox.mailbox import (
    DoubleBufferReader,
    DoubleBufferWriter,
    Reader,
    Reading,
    Writer,
)
from rack.backplane.mailbox.queue import QueueReader, QueueWriter
from rack.backplane.message import AnyMessage
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_lock_semaphore
from rack.backplane.words import Box

LOCK_WAIT_S = 0.002
"""Maximum time to wait for the lock.

A process holds it for one or two microseconds, or for some hundred if it is preempted.
"""


class MailboxLock:
    """Lock on one mailbox. A process waits for it only for a limited time.

    Attributes:
        held_up: Number of waits that timed out while a dead or stopped process held the lock.
            This is a fault, unlike a holder that has been preempted.
    """

    def __init__(self, segment: Segment, name: str, wait_s: float = LOCK_WAIT_S) -> None:
        self._semaphore = get_lock_semaphore(segment, name)
        self._owner = ByteLock(segment.fd, segment.map.mailboxes[name] + 8 * Box.OWNER)
        self._box = segment.get_box(name)
        self._wait_s = wait_s
        self.held_up = 0

    def acquire(self) -> bool:
        """Wait a limited time for the lock. Returns False if another process still holds it."""
        if not self._semaphore.acquire(self._wait_s):
            holder = self._box[Box.OWNER]
            # Read the owner again, because it may have released the lock and ended after the wait.
            if (
                holder
                and read_state(holder) in ENDED_STATES + STOPPED_STATES
                and self._box[Box.OWNER] == holder
            ):
                self.held_up += 1
        # Try the kernel's lock even after a timeout: it is free if the holder of the semaphore is
        # dead. It may be taken even if this process has obtained the semaphore, because another
        # process may have got it after a timeout.
        if not self._owner.take():
            return False
        self._box[Box.OWNER] = os.getpid()
        return True

    def release(self) -> None:
        """Release the lock. Only its owner may call this."""
        self._box[Box.OWNER] = 0
        self._owner.release()
        self._semaphore.release()

    def close(self) -> None:
        """Close the descriptor, which releases the lock."""
        self._owner.close()


class LockWriter(DoubleBufferWriter):
    """Writer under protocol lock, which publishes inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self.lock = MailboxLock(segment, name)

    def publish_message(
        self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()
    ) -> bool:
        """Publish `message` as `Writer.publish_message` does, inside the critical section."""
        obtained = self.lock.acquire()
        self.held_up = self.lock.held_up
        if not obtained:
            self.bus_errors += 1
            return False
        try:
            return super().publish_message(tick, visible_at, basis, damage)
        finally:
            self.lock.release()

    def close(self) -> None:
        """Release the lock and the claim."""
        self.lock.close()
        super().close()


class LockReader(Reader):
    """Reader under protocol lock, which copies the message inside the critical section."""

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self.lock = MailboxLock(segment, name)

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest message, with its verdict.

        If the wait for the lock times out, return the last good message with verdict BUS_ERROR.
        """
        statistics = self.statistics
        self.accesses += 1
        obtained = self.lock.acquire()
        if statistics.held_up != self.lock.held_up:
            statistics.held_up = self.lock.held_up
            statistics.bad_reads += 1
        if not obtained:
            return self._count_timeout()
        try:
            return self.peek()
        finally:
            self.lock.release()


WRITERS: dict[Protocol, type[Writer]] = {
    "time-slice": Writer,
    "double-buffer": DoubleBufferWriter,
    "lock": LockWriter,
    "queue": QueueWriter,
    "interrupt": InterruptWriter,
}
READERS: dict[Protocol, type[Reader]] = {
    "time-slice": Reader,
    "double-buffer": DoubleBufferReader,
    "lock": LockReader,
    "queue": QueueReader,
    # For readers that the messages do not interrupt: tasks in the writer's slot, and the host side.
    "interrupt": Reader,
}
OBSERVERS: dict[Protocol, type[Reader]] = {**READERS, "lock": DoubleBufferReader, "queue": Reader}
"""Readers that never take a lock and never remove a message from a queue, by protocol."""


def open_writer(segment: Segment, name: str) -> Writer:
    """Open and claim a mailbox for writing under its protocol.

    Raises:
        MailboxError: The mailbox has another writer.
    """
    return WRITERS[segment.layout.find_mailbox(name).protocol](segment, name)


def open_standby_writer(segment: Segment, name: str) -> Writer:
    """Open a mailbox under protocol time-slice or double-buffer, without claiming it."""
    return WRITERS[segment.layout.find_mailbox(name).protocol](segment, name, is_held=True)


def open_reader(
    segment: Segment, name: str, asynchronous: bool = False, inbox: BoardInbox | None = None
) -> Reader:
    """Open a mailbox for reading under its protocol.

    Args:
        segment: Memory of the rack.
        name: Name of the mailbox.
        asynchronous: True to read each message of protocol time-slice as soon as it is complete.
        inbox: Inbox of the reading board. None if nothing interrupts it.
    """
    if inbox is not None and name in inbox.lines:
        return InterruptReader(segment, name, inbox)
    protocol = segment.layout.find_mailbox(name).protocol
    if asynchronous and protocol == "time-slice":
        protocol = "double-buffer"
    return READERS[protocol](segment, name)


def open_observer(segment: Segment, name: str) -> Reader:
    """Open a mailbox so that reading its newest message has no effect on other processes.

    The clock and processes on the host side, such as tools, use observers.
    """
    return OBSERVERS[segment.layout.find_mailbox(name).protocol](segment, name)
