"""Reader of ring buffers in blocks, for the host side. It never slows the writer down."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rack.backplane.address_map import compute_oldest_intact
from rack.backplane.errors import DamageError

MAX_COUNT = 1 << 48
"""Upper bound of a valid record count. No ring is written this often."""


class NewRows(NamedTuple):
    """Result of reading a ring.

    Attributes:
        rows: The new rows, oldest first.
        lost: Number of rows that were overwritten before they could be read.
    """

    rows: np.ndarray
    lost: int


class Ring:
    """Ring buffer of fixed-size records that another process writes.

    Args:
        memory: Memory of the records.
        dtype: Type of a record.
        head: Word with the number of records written.
        before: Number of records of the run that this run continues, which are skipped.

    Attributes:
        taken: Number of records that were read or skipped. A reader that continues the work of
            another sets it.
    """

    def __init__(
        self, memory: memoryview, dtype: np.dtype, head: memoryview, before: int = 0
    ) -> None:
        # Copy rows as plain bytes. A copy field by field would omit the padding, which checksums
        # cover.
        self._rows = np.frombuffer(memory, dtype=f"V{dtype.itemsize}")
        self._dtype = dtype
        self._head = head
        self._depth = len(self._rows)
        self.before = self.taken = before

    @property
    def waiting_count(self) -> int:
        """Number of records written and not yet read."""
        return self._written_count - self.taken

    @property
    def _written_count(self) -> int:
        """Number of records written.

        Raises:
            DamageError: The number is negative or impossibly large.
        """
        if not 0 <= (count := self._head[0]) < MAX_COUNT:
            raise DamageError(f"a ring cannot have {count} records")
        return count

    def read_new_rows(self) -> NewRows:
        """Read the records written since the last call, except those already overwritten."""
        head = self._written_count
        first = max(self.taken + 1, head - self._depth + 1)
        rows = self._rows[np.arange(first, head + 1) % self._depth].view(self._dtype)
        # The writer may have overwritten the oldest rows during the copy.
        torn = max(0, compute_oldest_intact(self._written_count, self._depth) - first)
        lost = first - self.taken - 1 + min(torn, len(rows))
        # The head of a mailbox is set back if a stopped writer continues after a hand-over.
        self.taken = max(self.taken, head)
        return NewRows(rows[torn:], lost)
