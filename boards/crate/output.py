"""Output of host boards: lines of bounded length and number. Further lines are only counted."""

from __future__ import annotations

import os
import re
from contextlib import suppress

MOST_LINES = 10_000
"""Largest number of lines of one host board that a run keeps."""
LONGEST_LINE = 1000
"""Longest line in bytes. The rest of a longer line becomes another line."""
MOST_READ = 1 << 16
_LINE = re.compile(rb"[^\n]{%d}\n?|[^\n]*\n" % LONGEST_LINE)


def split_lines(data: bytes) -> list[bytes]:
    """Return the complete lines of output, each with its line end.

    Long lines are split. An incomplete last line is left out.
    """
    return _LINE.findall(data)


class HostOutput:
    """Pipe into which the processes of one host board print.

    The crate copies it to its own standard output.
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

    def copy_output(self, is_over: bool = False) -> None:
        """Copy new output to the crate's standard output, up to `MOST_LINES` lines in a run.

        Further lines are dropped. Their number is reported each time the total number of lines has
        doubled, and at the end.

        Args:
            is_over: Whether the board has ended, so that an incomplete last line is copied too.
        """
        with suppress(BlockingIOError):
            self._rest += os.read(self.reader, MOST_READ)
        if is_over and self._rest[-1:] not in b"\n":
            self._rest += b"\n"
        lines = split_lines(self._rest)
        self._rest = self._rest[sum(map(len, lines)) :]
        first_lines = lines[: max(0, MOST_LINES - self._lines)]
        self._lines += len(lines)
        if first_lines:
            os.write(1, b"".join(line.rstrip(b"\n") + b"\n" for line in first_lines))
        if self._lines >= self._next or (is_over and self._lines > MOST_LINES):
            self._next = 2 * self._lines
            text = (
                f"host board '{self._board}': {self._lines - MOST_LINES} lines dropped so far; a"
                f" run keeps the first {MOST_LINES}\n"
            )
            os.write(1, text.encode())
