"""An exclusive lock of the kernel's on one byte of a segment: taken at once or not at all.

It belongs to a file description of its own, so that two holders in one process exclude each other too,
and it ends with its process, however that ends.
"""

from __future__ import annotations

import fcntl
import os
import struct

from backplane.segment import Segment


class ByteLock:
    """The lock on the byte at a bus address."""

    def __init__(self, segment: Segment, address: int) -> None:
        self._fd = os.open(f"/proc/self/fd/{segment.fd}", os.O_RDWR | os.O_CLOEXEC)
        self._address = address

    def take(self) -> bool:
        """Take the lock; False when another has it."""
        try:
            self._request(fcntl.F_WRLCK)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def give_back(self) -> None:
        """Release the lock; it may be taken again."""
        self._request(fcntl.F_UNLCK)

    def close(self) -> None:
        """Release the lock for good."""
        os.close(self._fd)

    def _request(self, kind: int) -> None:
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", kind, os.SEEK_SET, self._address, 1, 0))
