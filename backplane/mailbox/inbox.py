"""Timing of a board's inbox under protocol interrupt: when messages are served, and which are lost.

An interrupt handler serves one message at a time, in the order of arrival. At most `depth` messages
wait. A message that arrives while `depth` messages wait is lost. All times are in ns. This module
does not use shared memory, so that boards, `rack check` and the analysis of recordings can use the
same arithmetic.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from heapq import merge
from typing import NamedTuple


class Inbox:
    """Model of a first-in-first-out server with room for a limited number of waiting messages.

    Attributes:
        depth: Maximum number of waiting messages.
        lost: Number of messages lost because they arrived while `depth` messages waited.
    """

    def __init__(self, depth: int) -> None:
        self.depth = depth
        self.lost = 0
        self.most_waiting = 0
        """Largest number of messages that waited at the same time."""
        self._free_ns = 0
        self._starts: deque[int] = deque()

    def add_message(self, at_ns: int, service_ns: int) -> int | None:
        """Add the arrival of a message. Arrivals must be added in the order of their times.

        Args:
            at_ns: Time of arrival.
            service_ns: Time that the handler takes to serve the message.

        Returns:
            The time at which the service ends. None if the message is lost.
        """
        starts = self._starts
        while starts and starts[0] <= at_ns:
            starts.popleft()
        if len(starts) >= self.depth:
            self.lost += 1
            return None
        start_ns = max(at_ns, self._free_ns)
        if start_ns > at_ns:
            starts.append(start_ns)
            self.most_waiting = max(self.most_waiting, len(starts))
        self._free_ns = start_ns + service_ns
        return self._free_ns


FULL_LOAD = 0.999
"""Load of a handler from which its inbox is considered overloaded.

It is below 1, so that the simulation of a burst stays short.
"""


class InterruptSource(NamedTuple):
    """Periodic messages: one arrives every `every_ns`, and serving it takes `service_ns`."""

    every_ns: int
    service_ns: int


class Burst(NamedTuple):
    """Worst case of an inbox: all sources send at the same time, and then once in each period.

    The burst ends when no message waits. At a load of `FULL_LOAD` or more it may never end, so
    `waiting` and `longest_ns` are not computed and are None.

    Attributes:
        load: Share of the processor time that the handler uses.
        waiting: Largest number of waiting messages.
        longest_ns: Longest time from the arrival of a message to the end of its service.
    """

    load: float
    waiting: int | None
    longest_ns: int | None

    def fits_depth(self, depth: int) -> bool:
        """Return True if an inbox with room for `depth` waiting messages never loses a message."""
        return self.waiting is not None and self.waiting <= depth


def compute_burst(sources: Sequence[InterruptSource]) -> Burst:
    """Compute the worst case of an inbox with these sources.

    The worst case is the busy period that begins when all sources send at the same time: the
    critical instant of a first-in-first-out server.
    """
    load = sum(source.service_ns / source.every_ns for source in sources)
    if load >= FULL_LOAD:
        return Burst(load, None, None)
    inbox = Inbox(sys.maxsize)
    free_ns = 0
    longest_ns = 0
    for at_ns, service_ns in merge(*(_iterate_arrivals(source) for source in sources)):
        # All arrivals at time 0 belong to the burst. It ends when a later arrival finds the handler
        # idle.
        if at_ns and at_ns >= free_ns:
            break
        end_ns = inbox.add_message(at_ns, service_ns)
        assert end_ns is not None, "it has room for all"
        free_ns = end_ns
        longest_ns = max(longest_ns, end_ns - at_ns)
    return Burst(load, inbox.most_waiting, longest_ns)


def _iterate_arrivals(source: InterruptSource) -> Iterator[tuple[int, int]]:
    """Yield time of arrival and service time of each message of a source, from time 0 on."""
    at_ns = 0
    while True:
        yield at_ns, source.service_ns
        at_ns += source.every_ns
