"""Worst-case cost and number of the interrupts that messages cause on a board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rack.backplane.mailbox.inbox import Burst, InterruptSource, compute_burst


@dataclass(frozen=True)
class InboxTiming:
    """Inbox of a board that messages interrupt.

    Attributes:
        task: Task that serves the inbox.
        mailboxes: Mailboxes whose messages interrupt the board.
        sources: Period and service time of each of these mailboxes' messages, in ns of simulated
            time, in the same order. The model assumes that each mailbox is written in every cycle
            of its writer.
        depth: Largest number of pending interrupts.
    """

    task: str
    mailboxes: tuple[str, ...]
    sources: tuple[InterruptSource, ...]
    depth: int

    def compute_cost_ns(self, span_ns: int) -> int:
        """Return the worst-case total processor time, in ns, of interrupts within `span_ns`.

        These are the interrupts that arrive in an interval of this length.
        """
        return sum(source.service_ns * -(-span_ns // source.every_ns) for source in self.sources)

    @property
    def burst(self) -> Burst:
        """Worst case, in which all sources send at the same time."""
        return compute_burst(self.sources)

    def to_document(self, cycle_ns: int) -> dict[str, Any]:
        """Return the worst case as plain data for JSON.

        `cycle_ns` is the task's cycle, or the time slice of its plan, in ns.
        """
        burst = self.burst
        return {
            "task": self.task,
            "mailboxes": list(self.mailboxes),
            "cycle_cost_ns": self.compute_cost_ns(cycle_ns),
            "load": burst.load,
            "depth": self.depth,
            "waiting": burst.waiting,
            "longest_ns": burst.longest_ns,
            "fits": burst.fits_depth(self.depth),
        }
