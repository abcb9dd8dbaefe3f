"""How old a mailbox's message is when it is read."""

from __future__ import annotations

import numpy as np
import rerun as rr

from rack.backplane.layout import Layout, MailboxSpec
from rack.tools.viewer.stream import Ints, RowBlock, Stream

AGES = "ages"


class Age:
    """Writes, at every release of a mailbox's fastest reader, the age in ms of the message that is visible then."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec, layout: Layout) -> None:
        self._stream, self._lane = stream, (AGES, mailbox.name)
        self._every = min([layout.task(reader).every for reader in mailbox.readers], default=mailbox.every)
        self._visible_at: Ints = np.empty(0, dtype=np.int64)
        self._made: Ints = np.empty(0, dtype=np.int64)
        self._upto = -1
        stream.static(self._lane, rr.SeriesLines(names=[f"{mailbox.name}, ms"]))

    def write(self, block: RowBlock) -> None:
        """Take messages down; they count from the tick at which they become visible."""
        self._visible_at = np.concatenate((self._visible_at, block.rows["visible_at"]))
        self._made = np.concatenate((self._made, block.ticks))

    def advance(self, tick: int) -> None:
        """Write the ages at all releases before `tick`; every message visible before it has been taken down."""
        every = self._every
        releases = np.arange((self._upto // every + 1) * every, tick, every)
        self._upto = max(self._upto, tick - 1)
        # A late message does not hide behind an earlier tick of a later one.
        newest = np.searchsorted(np.maximum.accumulate(self._visible_at), releases, side="right") - 1
        releases, newest = releases[newest >= 0], newest[newest >= 0]
        if not len(releases):
            return
        times = self._stream.times
        ages = (releases - self._made[newest]) * times.clock_ns * 1e-6
        self._stream.scalars(self._lane, times.columns(releases, times.stamps_of(releases)), ages)
        self._visible_at, self._made = self._visible_at[newest[-1] :], self._made[newest[-1] :]
