"""Reader of regular files of bounded size.

A path that a user or another program names may lead to a FIFO, which blocks the process that opens
it, to a device, which acts or never ends, or to a file that is too large for memory.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

PIECE_BYTES = 1 << 20
_KINDS = {
    stat.S_IFBLK: "block device",
    stat.S_IFCHR: "character device",
    stat.S_IFDIR: "directory",
    stat.S_IFIFO: "FIFO",
    stat.S_IFSOCK: "socket",
}


class RefusedFileError(OSError):
    """Raised for a file that is not a regular file or is too large.

    `strerror` states the reason as a sentence.
    """

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


def read_regular_file(path: Path, limit_bytes: int) -> bytes:
    """Return the content of a regular file. Never blocks, even if the path leads to a FIFO.

    Args:
        path: File to read. Symbolic links are followed.
        limit_bytes: Largest permitted size.

    Raises:
        RefusedFileError: The file is not a regular file, or it is too large.
        OSError: The file cannot be opened or read.
    """
    # Merely opening a device can have side effects, so the kind is checked first. It is checked
    # again once the file is open, because the path may name another file by that time.
    check_regular_file(path, limit_bytes)
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
    with os.fdopen(os.open(path, flags), "rb") as file:
        _check_status(path, os.fstat(file.fileno()), limit_bytes)
        content = bytearray()
        # Files of /proc and files that are being written may contain more bytes than their size.
        while piece := file.read(PIECE_BYTES):
            content += piece
            _check_size(path, len(content), limit_bytes)
    return bytes(content)


def check_regular_file(path: Path, limit_bytes: int) -> None:
    """Check the kind and size of a file before a library opens it by its path.

    Args:
        path: File to check. Symbolic links are followed.
        limit_bytes: Largest permitted size.

    Raises:
        RefusedFileError: The file is not a regular file, or it is too large.
        OSError: The file does not exist, or its folder cannot be searched.
    """
    _check_status(path, path.stat(), limit_bytes)


def _check_status(path: Path, status: os.stat_result, limit_bytes: int) -> None:
    """Raise `RefusedFileError` unless a status describes a regular file within the limit."""
    if not stat.S_ISREG(status.st_mode):
        reason = f"not a regular file, but a {_KINDS[stat.S_IFMT(status.st_mode)]}"
        raise RefusedFileError(errno.EINVAL, reason, str(path))
    _check_size(path, status.st_size, limit_bytes)


def _check_size(path: Path, size: int, limit_bytes: int) -> None:
    """Raise `RefusedFileError` if a file is larger than the limit."""
    if size > limit_bytes:
        reason = f"too large: {size} bytes; the limit is {limit_bytes}"
        raise RefusedFileError(errno.EFBIG, reason, str(path))
