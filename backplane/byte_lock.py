"""An exclusive, non-blocking kernel lock on one byte of a segment.

Each lock has its own file description, so two holders in one process exclude each other too. The
kernel releases it when the process ends, even if it is killed.

Alternative considered: record locks of a process, which a fork does not inherit. The kernel would
release them as soon as their process closes any other descriptor of the same file.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakSet

_HELD: set[ProcessLock] = set()
_OPEN: WeakSet[ByteLock] = WeakSet()
_FLOCK = struct.Struct("hhqqi4x")
"""`struct flock` of 64-bit Linux: type, whence, start, length, pid (0: locks of a file description
have none)."""


class ByteLock:
    """The lock on the byte at a bus address of an open segment."""

    def __init__(self, fd: int, address: int) -> None:
        self.reopen(fd)
        _OPEN.add(self)
        self._take = _one_byte(fcntl.F_WRLCK, address)
        self._unlock = _one_byte(fcntl.F_UNLCK, address)

    def reopen(self, fd: int) -> None:
        """Use another segment, open as `fd`; the lock is not taken there."""
        self._fd = os.open(f"/proc/self/fd/{fd}", os.O_RDWR | os.O_CLOEXEC)

    def take(self) -> bool:
        """Take the lock; False when it is held already."""
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, self._take)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def release(self) -> None:
        """Release the lock; it may be taken again."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, self._unlock)

    def close(self) -> None:
        """Release the lock and its descriptor; may be called again."""
        _OPEN.discard(self)
        self.close_file()

    def close_file(self) -> None:
        """Close the descriptor until `reopen`. A process from which this one was forked keeps the
        lock.
        """
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


@contextmanager
def locked(fd: int, address: int) -> Iterator[None]:
    """Hold a lock for a moment, in which an entry of a table is filled; other processes wait for it
    no longer.
    """
    lock = ByteLock(fd, address)
    try:
        while not lock.take():
            continue
        yield
    finally:
        lock.close()


class ProcessLock(ByteLock):
    """A lock that ends with the process that made it. Processes that this one forks lose it."""

    def __init__(self, fd: int, address: int) -> None:
        super().__init__(fd, address)
        _HELD.add(self)

    def close(self) -> None:
        """Release the lock and its descriptor; may be called again."""
        _HELD.discard(self)
        super().close()


def _close_inherited() -> None:
    # The parent keeps its lock: it belongs to the file description, which both have open.
    for lock in [*_HELD]:
        lock.close()


os.register_at_fork(after_in_child=_close_inherited)


def close_all() -> None:
    """Close the descriptors of all locks of this process, a fork, until `reopen_all`."""
    for lock in _OPEN:
        lock.close_file()


def reopen_all(fd: int) -> None:
    """Let all locks be those of another segment, open as `fd`; none is taken there."""
    for lock in _OPEN:
        lock.reopen(fd)


def is_locked(fd: int, address: int) -> bool:
    """Return whether the byte at a bus address of an open segment is locked, without taking the
    lock.
    """
    asked = _one_byte(fcntl.F_RDLCK, address)
    kind: int = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, asked))[0]
    return kind != fcntl.F_UNLCK


def _one_byte(kind: int, address: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, address, 1, 0)
