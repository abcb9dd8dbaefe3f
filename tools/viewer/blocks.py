"""What a part of the view is given: a block of rows of one mailbox or of one task's trace."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
import rerun as rr

from rack.tools.viewer.timelines import Ints, Timelines


class Block:
    """Rows of one ring, oldest first, with their times.

    A mailbox's rows have the fields of `rack.backplane.mailbox.history.MailboxRing`, those of a trace the fields of
    `rack.backplane.trace.RECORD`.
    """

    def __init__(self, rows: np.ndarray, stamp: str, timelines: Timelines) -> None:
        self.rows = rows
        self.ticks: Ints = rows["tick"].astype(np.int64)
        self.stamps_ns: Ints = rows[stamp].astype(np.int64)
        self._timelines = timelines

    @cached_property
    def times(self) -> list[rr.TimeColumn]:
        """The time columns of all rows, made once for every part that writes them."""
        return self._timelines.columns(self.ticks, self.stamps_ns)

    @property
    def messages(self) -> np.ndarray:
        """The messages of a mailbox's rows."""
        return np.asarray(self.rows["message"])


class Part(Protocol):
    """Writes one concern of one mailbox or task to the stream."""

    def write(self, block: Block) -> None:
        """Write a block of rows."""


class Changes:
    """Finds the rows of consecutive blocks in which a value is another than before."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None

    def rows(self, values: np.ndarray) -> Ints:
        """Return the indices of the rows that differ from the row before; shape of `values` (rows,) or structured."""
        before = values[:1] if self._last is None else self._last
        changed = values != np.concatenate((before, values[:-1]))
        changed[0] |= self._last is None
        self._last = values[-1:].copy()
        return np.flatnonzero(changed)
