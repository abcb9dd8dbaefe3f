"""Worst-case cost and number of the interrupts that messages cause on a board."""

from __future__ import annotations

from dataclasses import dataclass
from math import lcm
from typing import Any

from rack.backplane.mailbox.inbox import (
    MAX_PREEMPTED_CYCLES,
    Burst,
    Inbox,
    InterruptSource,
    Work,
    compute_burst,
)
from rack.boards.timing.response_time import compute_response_time

MAX_EVENTS = 20_000
"""Largest number of messages and computations that are simulated, until they repeat."""


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
        period_ns: Time between two computations of the task.
        first_ns: Time of the first of them.
    """

    task: str
    mailboxes: tuple[str, ...]
    sources: tuple[InterruptSource, ...]
    depth: int
    period_ns: int
    first_ns: int

    def compute_cost_ns(self, time_ns: int) -> int:
        """Return the longest time in ns that handlers take from a computation of `time_ns`.

        It follows from the times at which the messages arrive. If these are not known or repeat
        only after a very long time, all messages are assumed to arrive when the computation begins.
        """
        if not time_ns:
            return 0
        periods_ns = [self.period_ns, *(source.every_ns for source in self.sources)]
        whole_ns = lcm(*periods_ns)
        longest_ns = MAX_PREEMPTED_CYCLES * self.period_ns
        count = sum(whole_ns // period_ns for period_ns in periods_ns)
        if count > MAX_EVENTS or not all(source.is_periodic for source in self.sources):
            loads = [(source.service_ns, source.every_ns) for source in self.sources]
            horizon_ns = time_ns + longest_ns
            end_ns = compute_response_time(time_ns, loads, 0, sharing=(), horizon=horizon_ns)
            return longest_ns if end_ns is None else end_ns - time_ns
        # After the latest first message, everything repeats.
        settled_ns = max(self.first_ns, *(source.at_ns for source in self.sources)) + whole_ns
        inbox = Inbox(self.depth)
        since_ns = -1
        worst_ns = 0
        begin_ns = self.first_ns
        while begin_ns < settled_ns + whole_ns:
            inbox.add_arrivals(self.sources, since_ns, begin_ns)
            since_ns = begin_ns
            work = Work(begin_ns, time_ns, begin_ns + time_ns + longest_ns)
            end_ns = inbox.compute_end(work, self.sources, begin_ns)
            worst_ns = max(worst_ns, end_ns - begin_ns - time_ns)
            begin_ns += self.period_ns
        return worst_ns

    @property
    def burst(self) -> Burst:
        """Worst case, in which all sources send at the same time."""
        return compute_burst(self.sources)

    def to_document(self, cost_ns: int) -> dict[str, Any]:
        """Return the worst case as plain data for JSON.

        `cost_ns` is the longest time that interrupts take from a computation, in ns.
        """
        burst = self.burst
        return {
            "task": self.task,
            "mailboxes": list(self.mailboxes),
            "cycle_cost_ns": cost_ns,
            "load": burst.load,
            "depth": self.depth,
            "waiting": burst.waiting,
            "longest_ns": burst.longest_ns,
            "fits": burst.fits_depth(self.depth),
        }
