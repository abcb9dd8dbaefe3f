"""What host boards print: lines of bounded length, of each board as many as a run keeps; the others
are counted.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress

MOST_LINES = 10_000
"""Lines of one host board that a run keeps."""
LONGEST_LINE = 1000
"""Bytes after which a line is cut: what follows is a line of its own."""
MOST_READ = 1 << 16
_LINE = re.compile(rb"[^\n]{%d}\n?|[^\n]*\n" % LONGEST_LINE)


def lines_of(data: bytes) -> list[bytes]:
    """Return the lines that are whole or cut, with their ends; the rest is a line that has not
    ended.
    """
    return _LINE.findall(data)


class HostOutput:
    """The pipe into which all processes of one host board print. The crate empties it to its own
    stdout.
    """

    def __init__(self, board: str) -> None:
        self._board = board
        self._rest = b""
        self._lines = 0
        self._next = MOST_LINES + 1
        self.reader, self.writer = os.pipe()
        os.set_blocking(self.reader, False)

    def close(self) -> None:
        """Close the pipe."""
        os.close(self.reader)
        os.close(self.writer)

    def pass_on(self, is_over: bool = False) -> None:
        """Pass on what has come; say what was dropped each time that it has doubled, and when the
        board `is_over`.
        """
        with suppress(BlockingIOError):
            self._rest += os.read(self.reader, MOST_READ)
        if is_over and self._rest[-1:] not in b"\n":
            self._rest += b"\n"
        lines = lines_of(self._rest)
        self._rest = self._rest[sum(map(len, lines)) :]
        kept = lines[: max(0, MOST_LINES - self._lines)]
        self._lines += len(lines)
        if kept:
            os.write(1, b"".join(line.rstrip(b"\n") + b"\n" for line in kept))
        if self._lines >= self._next or (is_over and self._lines > MOST_LINES):
            self._next = 2 * self._lines
            dropped = self._lines - MOST_LINES
            text = (
                f"host board '{self._board}': {dropped} lines dropped so far; a run keeps the first"
                f" {MOST_LINES}\n"
            )
            os.write(1, text.encode())
