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
from operator import itemgetter
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
        self.free_ns = 0
        """Time at which the handler has served all messages added so far."""
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
        start_ns = max(at_ns, self.free_ns)
        if start_ns > at_ns:
            starts.append(start_ns)
            self.most_waiting = max(self.most_waiting, len(starts))
        self.free_ns = start_ns + service_ns
        return self.free_ns

    def add_arrivals(
        self, sources: Sequence[InterruptSource], since_ns: int, until_ns: int
    ) -> None:
        """Add the messages that arrive after `since_ns` and up to `until_ns`.

        Args:
            sources: Periodic messages.
            since_ns: Time up to which messages have been added.
            until_ns: Time of the last message to add.
        """
        for at_ns, service_ns in _merge_arrivals(sources, since_ns):
            if at_ns > until_ns:
                break
            self.add_message(at_ns, service_ns)

    def compute_end(self, work: Work, sources: Sequence[InterruptSource], since_ns: int) -> int:
        """Return when a computation ends that the handler preempts. The inbox does not change.

        Args:
            work: The computation.
            sources: Periodic messages that will arrive, in addition to those already added.
            since_ns: Time after which these messages arrive.
        """
        ahead = Inbox(self.depth)
        ahead.free_ns = self.free_ns
        ahead._starts.extend(self._starts)
        end_ns = work.begin_ns + max(0, self.free_ns - work.begin_ns) + work.time_ns
        for at_ns, service_ns in _merge_arrivals(sources, since_ns):
            if at_ns >= min(end_ns, work.limit_ns):
                break
            if (served_ns := ahead.add_message(at_ns, service_ns)) is not None:
                end_ns += max(0, served_ns - max(served_ns - service_ns, work.begin_ns))
        return min(end_ns, work.limit_ns)


MAX_PREEMPTED_CYCLES = 8
"""Number of cycles after which a computation ends although its handler never rests."""
FULL_LOAD = 0.999
"""Load of a handler from which its inbox is considered overloaded.

It is below 1, so that the simulation of a burst stays short.
"""


class Work(NamedTuple):
    """Computation that begins at `begin_ns` and takes `time_ns` of its processor.

    A handler that is always busy would keep it from ending, so it is taken to end at `limit_ns`.
    """

    begin_ns: int
    time_ns: int
    limit_ns: int


class InterruptSource(NamedTuple):
    """Periodic messages: one arrives every `every_ns`, and serving it takes `service_ns`.

    Attributes:
        at_ns: Time at which the first of them arrives.
        is_periodic: False for messages of a planner, which may come at any time.
    """

    every_ns: int
    service_ns: int
    at_ns: int = 0
    is_periodic: bool = True


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
    together = [source._replace(at_ns=0) for source in sources]
    for at_ns, service_ns in _merge_arrivals(together, -1):
        # All arrivals at time 0 belong to the burst. It ends when a later arrival finds the handler
        # idle.
        if at_ns and at_ns >= free_ns:
            break
        end_ns = inbox.add_message(at_ns, service_ns)
        assert end_ns is not None, "it has room for all"
        free_ns = end_ns
        longest_ns = max(longest_ns, end_ns - at_ns)
    return Burst(load, inbox.most_waiting, longest_ns)


def _merge_arrivals(sources: Sequence[InterruptSource], since_ns: int) -> Iterator[tuple[int, int]]:
    """Yield the arrivals of all sources after `since_ns`, by time and then by source.

    Each is the time of arrival and the service time of a message.
    """
    return merge(*(_iterate_arrivals(source, since_ns) for source in sources), key=itemgetter(0))


def _iterate_arrivals(source: InterruptSource, since_ns: int) -> Iterator[tuple[int, int]]:
    """Yield the arrivals of one source after `since_ns`."""
    at_ns = source.at_ns
    if since_ns >= at_ns:
        at_ns += ((since_ns - at_ns) // source.every_ns + 1) * source.every_ns
    while True:
        yield at_ns, source.service_ns
        at_ns += source.every_ns
