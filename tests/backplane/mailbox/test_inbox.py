"""Timing of an inbox: one message served at a time, in order of arrival, within its bound."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rack.backplane.mailbox.inbox import Inbox, InterruptSource, Work, compute_burst

ARRIVALS = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 30)), max_size=60)
"""Pauses before messages, and their services."""


def test_a_message_for_a_full_inbox_is_lost_and_takes_no_service_time() -> None:
    inbox = Inbox(2)
    assert [inbox.add_message(0, 60) for _ in range(4)] == [60, 120, 180, None]
    # At 60 the first is done: a place to wait is free again.
    assert [inbox.add_message(59, 60), inbox.add_message(60, 60)] == [None, 240]
    assert (inbox.lost, inbox.most_waiting) == (2, 2)


@given(ARRIVALS, st.integers(1, 5))
def test_no_two_services_overlap_and_no_more_wait_than_permitted(
    pauses: list[tuple[int, int]], depth: int
) -> None:
    inbox, at, served = Inbox(depth), 0, list[tuple[int, int, int]]()
    for pause, service in pauses:
        at += pause
        waiting = sum(end - took > at for _, end, took in served)
        end = inbox.add_message(at, service)
        assert (end is None) == (waiting >= depth)
        if end is not None:
            served.append((at, end, service))
    for (_, before, _), (arrived, end, took) in pairwise(served):
        assert end - took == max(arrived, before)
    assert inbox.lost == len(pauses) - len(served)
    assert inbox.most_waiting <= depth


SOURCES = st.lists(
    st.builds(InterruptSource, st.integers(4, 40), st.integers(0, 12), st.integers(0, 50)),
    max_size=4,
)
LIMIT = 400


@given(SOURCES, st.integers(1, 4), st.integers(0, 60), st.integers(1, 40))
def test_a_computation_runs_whenever_the_handler_is_idle(
    sources: list[InterruptSource], depth: int, begin: int, time: int
) -> None:
    inbox, busy = Inbox(depth), set[int]()
    arrivals = sorted(
        (at, number, source.service_ns)
        for number, source in enumerate(sources)
        for at in range(source.at_ns, 2 * LIMIT, source.every_ns)
    )
    for at, _, service in arrivals:
        if (end := inbox.add_message(at, service)) is not None:
            busy.update(range(end - service, end))
    idle = [at for at in range(begin, 2 * LIMIT) if at not in busy]
    expected = 1 + idle[time - 1] if len(idle) >= time else LIMIT
    known = Inbox(depth)
    known.add_arrivals(sources, -1, begin)
    found = known.compute_end(Work(begin, time, LIMIT), sources, begin)
    assert found == min(expected, LIMIT)
    assert known.compute_end(Work(begin, time, LIMIT), sources, begin) == found


def test_a_burst_of_all_senders_waits_for_each_other() -> None:
    burst = compute_burst([InterruptSource(2_500, 60)] * 5)
    assert (burst.waiting, burst.longest_ns) == (4, 300)
    assert burst.load == pytest.approx(0.12)
    assert burst.fits_depth(4)
    assert not burst.fits_depth(3)


def test_a_burst_includes_messages_that_arrive_during_its_service() -> None:
    # From 0: 300 of service, during which the fast source comes twice more.
    burst = compute_burst([InterruptSource(100, 10), InterruptSource(1_000, 250)])
    assert burst.longest_ns == 260
    assert burst.waiting == 2


@pytest.mark.parametrize("service", [500, 600])
def test_a_handler_that_is_never_idle_fills_every_inbox(service: int) -> None:
    burst = compute_burst([InterruptSource(2_500, service)] * 5)
    assert burst.waiting is burst.longest_ns is None
    assert not burst.fits_depth(1_000_000)
