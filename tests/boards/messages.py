"""Everything that a run wrote, to compare runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.process import is_alive
from rack.backplane.segment import Segment
from rack.backplane.trace import Flag, open_trace_ring
from rack.backplane.words import Block
from rack.boards import Rack
from tests.processes import wait_until

WHAT = ("serial", "tick", "visible_at", "basis", "chain")


@dataclass(frozen=True)
class Written:
    """The messages of a run by mailbox, and its cycles by task; complete if the run is shorter than
    the rings."""

    messages: dict[str, np.ndarray]
    cycles: dict[str, np.ndarray]

    @classmethod
    def on(cls, segment: Segment) -> Written:
        """Read everything from a segment, once the cycles that were under way at the end of the run
        have ended."""
        blocks = [segment.get_block(task.name) for task in segment.layout.tasks]
        wait_until(
            lambda: all(
                b[Block.DONE] >= b[Block.RELEASED] or not is_alive(b[Block.PID]) for b in blocks
            )
        )
        messages, cycles = {}, {}
        for mailbox in segment.layout.mailboxes:
            messages[mailbox.name], lost = MailboxRing(segment, mailbox.name).read_new_rows()
            assert not lost
        for task in segment.layout.tasks:
            cycles[task.name], lost = open_trace_ring(segment, task.name).read_new_rows()
            assert not lost
        return cls(messages, cycles)

    def first_miss(self, otherwise: int) -> int:
        """Return the first tick at which a task missed or skipped a release; `otherwise` when none
        did."""
        found = [otherwise]
        for rows in self.cycles.values():
            late = np.flatnonzero(rows["flags"] & (Flag.MISSED | Flag.SKIPPED))
            # Skipped releases follow the cycle before.
            found += [int(rows["tick"][at - 1]) + 1 if at else 0 for at in late[:1]]
        return min(found)

    def until(self, tick: int) -> dict[str, list[tuple[int, ...]]]:
        """Return what was released before `tick`, by mailbox: serials, ticks and running hashes."""
        return {
            name: [tuple(int(row[word]) for word in WHAT) for row in rows[rows["tick"] < tick]]
            for name, rows in self.messages.items()
        }


def run_and_read(rack: Rack, seconds: float) -> Written:
    """Run a rack, and return what it wrote."""
    with rack:
        rack.run(seconds)
        return Written.on(rack.segment)
