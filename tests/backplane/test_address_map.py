"""Memory map: windows on pages, without overlaps."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rack.backplane.address_map import (
    ALARM_SIZE,
    BLOCK_SIZE,
    CACHE_LINE,
    FAULT_ENTRIES,
    FAULT_ENTRY_SIZE,
    HEAD_SIZE,
    MAILBOX_HEAD_SIZE,
    OPERATOR_ENTRIES,
    PAGE,
    TRACE_RECORD_SIZE,
    AddressMap,
    compute_operator_entry_size,
    compute_slot_stride,
)
from rack.backplane.layout import Layout, TaskSpec, compute_depth
from rack.backplane.words import Block, Head, System
from tests.backplane.bus import layout, mailbox, task

PLANNER = TaskSpec("writer.planner", "writer", "planner", 2, 0, 0, 8, 4, 64)


@pytest.fixture
def full() -> Layout:
    boxes = [
        mailbox(name=f"writer.{n}", depth=depth) for n, depth in (("a", 4), ("b", 64), ("c", 8))
    ]
    boxes += [mailbox(name="reader.operator", writer="clock")]
    return layout("full", boxes, [task("writer"), PLANNER, task("reader", slot=3)])


def test_windows_follow_each_other_on_pages(full: Layout) -> None:
    places = AddressMap(full)
    starts = [places.faults, places.blocks["writer"], places.blocks["reader"]]
    assert starts[0] == HEAD_SIZE
    assert starts == sorted(starts)
    assert all(start % PAGE == 0 for start in starts)
    # The semaphores follow.
    first_semaphore = min(places.wake.values())
    assert first_semaphore % PAGE == 0
    assert places.size == first_semaphore + PAGE


def test_no_two_writers_share_a_cache_line(full: Layout) -> None:
    places = AddressMap(full)
    areas = [(places.blocks[t.name], BLOCK_SIZE) for t in full.tasks]
    areas += [(places.traces[t.name], t.depth * TRACE_RECORD_SIZE) for t in full.tasks]
    areas += [
        (places.mailboxes[m.name], MAILBOX_HEAD_SIZE + m.depth * compute_slot_stride(m))
        for m in full.mailboxes
    ]
    areas += [(address, ALARM_SIZE) for address in places.alarms.values()]
    areas += [(places.faults, FAULT_ENTRIES * FAULT_ENTRY_SIZE)]
    areas += [(places.operator, OPERATOR_ENTRIES * compute_operator_entry_size(full))]
    areas.sort()
    assert all(address % CACHE_LINE == 0 for address, _ in areas)
    assert all(address + size <= following for (address, size), (following, _) in pairwise(areas))


def test_everything_that_a_board_writes_is_in_its_window(full: Layout) -> None:
    places = AddressMap(full)
    boxes, blocks = places.mailboxes, places.blocks
    of_writer = (boxes["writer.a"], boxes["writer.c"], blocks["writer"], blocks["writer.planner"])
    of_clock = (places.operator, boxes["reader.operator"])
    starts = [HEAD_SIZE, places.blocks["writer"], places.blocks["reader"]]
    for (start, end), addresses in zip(pairwise(starts), (of_clock, of_writer), strict=True):
        assert all(start <= address < end for address in addresses)
    assert compute_operator_entry_size(full) >= full.find_mailbox("reader.operator").size


def words_of(kind: type) -> list[int]:
    return [place for name, place in vars(kind).items() if name.isupper()]


def test_shared_words_fit_their_places() -> None:
    last_slot = 21
    assert max(words_of(Head)) < min(words_of(System))
    assert (System.SYSFAIL + last_slot + 1) * 8 <= HEAD_SIZE
    assert (max(words_of(Block)) + 1) * 8 <= BLOCK_SIZE


@pytest.mark.parametrize(
    ("span_ticks", "every", "slots"),
    [(0, 1, 4), (1, 1, 4), (2, 1, 8), (800, 1, 1024), (800, 8, 128)],
)
def test_depth_keeps_the_span_in_a_power_of_two(span_ticks: int, every: int, slots: int) -> None:
    assert compute_depth(span_ticks, every) == slots
