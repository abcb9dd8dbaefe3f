"""Exclusive, non-blocking kernel lock on one byte of a segment.

Each lock has its own file description, so two holders in one process exclude each other too. The
kernel releases the lock when the process ends, even if it is killed.

Alternative considered: record locks of a process, which a fork does not inherit. The kernel would
release them as soon as the process closes any other descriptor of the same file.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_OPEN: set[ByteLock] = set()
_FLOCK = struct.Struct("hhqqi4x")
"""Fields of `struct flock` on 64-bit Linux: type, whence, start, length and pid.

The pid is 0 for a lock that belongs to a file description.
"""


class ByteLock:
    """Lock on the byte at a bus address of an open segment."""

    def __init__(self, fd: int, address: int) -> None:
        self.reopen(fd)
        _OPEN.add(self)
        self._take = _pack_lock_request(fcntl.F_WRLCK, address)
        self._unlock = _pack_lock_request(fcntl.F_UNLCK, address)

    def reopen(self, fd: int) -> None:
        """Switch to the same byte of another segment, without taking the lock there.

        Args:
            fd: Descriptor of the other segment.
        """
        self._fd = os.open(f"/proc/self/fd/{fd}", os.O_RDWR | os.O_CLOEXEC)

    def take(self) -> bool:
        """Take the lock without waiting. Returns False if it is already held."""
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, self._take)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def release(self) -> None:
        """Release the lock, so that it can be taken again."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, self._unlock)

    def close(self) -> None:
        """Release the lock and close its descriptor. Repeated calls have no effect."""
        _OPEN.discard(self)
        self.close_file()

    def close_file(self) -> None:
        """Close the descriptor. `reopen` opens one again.

        This releases the lock, unless another process, such as the parent of a fork, shares the
        file description.
        """
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


@contextmanager
def hold_lock(fd: int, address: int) -> Iterator[None]:
    """Hold the lock on a byte inside a `with` block, for example to fill a shared table's entry.

    If another process holds the lock, the calling process spins until it is released.
    """
    lock = ByteLock(fd, address)
    try:
        while not lock.take():
            continue
        yield
    finally:
        lock.close()


class ProcessLock(ByteLock):
    """Lock that ends with the process that created it. Forked children do not inherit it."""


def _close_inherited() -> None:
    """Close the descriptors of the process locks in a forked child. The parent keeps the locks."""
    # Otherwise the locks would outlast the parent: the kernel keeps a lock as long as any process
    # has its file description open.
    for lock in [*_OPEN]:
        if isinstance(lock, ProcessLock):
            lock.close()


os.register_at_fork(after_in_child=_close_inherited)


def close_all_files() -> None:
    """Close the descriptors of all byte locks of this process. `reopen_all` opens them again."""
    for lock in _OPEN:
        lock.close_file()


def reopen_all(fd: int) -> None:
    """Switch all locks to another segment, without taking any of them.

    Args:
        fd: Descriptor of the other segment.
    """
    for lock in _OPEN:
        lock.reopen(fd)


def is_locked(fd: int, address: int) -> bool:
    """Check whether any process holds the lock on a byte, without taking the lock.

    Args:
        fd: Descriptor of the segment.
        address: Bus address of the byte.
    """
    request = _pack_lock_request(fcntl.F_RDLCK, address)
    kind: int = _FLOCK.unpack(fcntl.fcntl(fd, fcntl.F_OFD_GETLK, request))[0]
    return kind != fcntl.F_UNLCK


def holds_lock(pid: int, fd: int, address: int) -> bool:
    """Check whether a process holds the lock on a byte. False if its files cannot be examined.

    Args:
        pid: The process.
        fd: Descriptor of the segment.
        address: Bus address of the byte.
    """
    place = [str(os.fstat(fd).st_ino), str(address), str(address)]
    texts = []
    with suppress(OSError):
        for path in Path(f"/proc/{pid}/fdinfo").iterdir():
            texts.append(path.read_text())
    # A line ends with device, inode, first byte and last byte: "lock: ... 00:1b:68789 8 8".
    lines = (line.replace(":", " ").split() for text in texts for line in text.splitlines())
    return any(words[:1] == ["lock"] and words[-3:] == place for words in lines)


def _pack_lock_request(kind: int, address: int) -> bytes:
    """Pack a `struct flock` for one byte. `kind` is a lock type such as `fcntl.F_WRLCK`."""
    return _FLOCK.pack(kind, os.SEEK_SET, address, 1, 0)
