"""What messages that interrupt a board cost it, and how many of them wait, in the worst case."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rack.backplane.mailbox.inbox import Burst, InterruptSource, burst_of


@dataclass(frozen=True)
class InboxTiming:
    """The inbox of a board, served by its task `task`; `depth` messages may wait.

    `mailboxes` are those whose messages interrupt it, `sources` their periods and services, in the
    same order; ns of simulated time. A mailbox that is not written in every cycle counts as if it
    were.
    """

    task: str
    mailboxes: tuple[str, ...]
    sources: tuple[InterruptSource, ...]
    depth: int

    def cost_ns(self, span_ns: int) -> int:
        """Return the processor time of the handler for what comes in a span of time."""
        return sum(source.service_ns * -(-span_ns // source.every_ns) for source in self.sources)

    @property
    def burst(self) -> Burst:
        """The worst case: all sources send at once."""
        return burst_of(self.sources)

    def document(self, cycle_ns: int) -> dict[str, Any]:
        """Return it as plain data, with its cost in a cycle of its board; ns."""
        burst = self.burst
        return {
            "task": self.task,
            "mailboxes": list(self.mailboxes),
            "cycle_cost_ns": self.cost_ns(cycle_ns),
            "load": burst.load,
            "depth": self.depth,
            "waiting": burst.waiting,
            "longest_ns": burst.longest_ns,
            "fits": burst.fits(self.depth),
        }
