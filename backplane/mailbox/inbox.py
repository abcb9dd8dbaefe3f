"""The inbox of a board under protocol interrupt, as arithmetic: which messages are served, when,
and which are lost.

An interrupt handler serves one message at a time, in the order of arrival. `depth` messages may
wait; one that arrives when so many wait is lost. All times are ns. Nothing here knows of shared
memory: boards, `rack check` and recordings use the same arithmetic.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from heapq import merge
from typing import NamedTuple


class Inbox:
    """A first-in-first-out server with `depth` places to wait. `lost` counts arrivals that found
    all of them taken.
    """

    def __init__(self, depth: int) -> None:
        self.depth = depth
        self.lost = 0
        self.most_waiting = 0
        """The largest number of messages that waited at the same time."""
        self._free_ns = 0
        self._starts: deque[int] = deque()

    def arrive(self, at_ns: int, service_ns: int) -> int | None:
        """Return the end of the service of a message that arrives, not before the last one; None:
        it is lost.
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
"""Load of a handler from which its inbox counts as filling up: below 1 already, so that bursts stay
short to follow."""


class InterruptSource(NamedTuple):
    """Messages that arrive every `every_ns`, each served for `service_ns`."""

    every_ns: int
    service_ns: int


class Burst(NamedTuple):
    """The worst case of an inbox: every source sends at once, then in each of its periods, until
    nothing waits.

    `waiting` is the most that wait, `longest_ns` the longest time from arrival to the end of
    service, `load` the handler's part of the processor. From `FULL_LOAD` on the inbox fills up,
    whatever its depth: both are then None.
    """

    load: float
    waiting: int | None
    longest_ns: int | None

    def fits(self, depth: int) -> bool:
        """Say whether no message is ever lost if `depth` may wait."""
        return self.waiting is not None and self.waiting <= depth


def burst_of(sources: Sequence[InterruptSource]) -> Burst:
    """Return the worst case of an inbox with these sources: the critical instant of a
    first-in-first-out server.
    """
    load = sum(source.service_ns / source.every_ns for source in sources)
    if load >= FULL_LOAD:
        return Burst(load, None, None)
    inbox = Inbox(sys.maxsize)
    free_ns = 0
    longest_ns = 0
    for at_ns, service_ns in merge(*(_arrivals(source) for source in sources)):
        # The arrivals of one instant come together: the first period ends where the next one begins
        # idle.
        if at_ns and at_ns >= free_ns:
            break
        end_ns = inbox.arrive(at_ns, service_ns)
        assert end_ns is not None, "it has room for all"
        free_ns = end_ns
        longest_ns = max(longest_ns, end_ns - at_ns)
    return Burst(load, inbox.most_waiting, longest_ns)


def _arrivals(source: InterruptSource) -> Iterator[tuple[int, int]]:
    at_ns = 0
    while True:
        yield at_ns, source.service_ns
        at_ns += source.every_ns
