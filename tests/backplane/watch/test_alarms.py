"""Alarm rings: every alarm once, in order, and a writer that never waits."""

from __future__ import annotations

import os

import pytest

from rack.backplane.ring import Ring
from rack.backplane.watch.alarms import (
    CLEAN_READS,
    MISSES,
    Alarm,
    AlarmWriter,
    Episodes,
    open_alarm_ring,
)
from tests.backplane.bus import mailbox
from tests.backplane.conftest import MakeBus

EVERY = 4
"""Ticks of a cycle of the mailbox's writer."""


def test_alarms_are_read_as_they_were_rung(make_bus: MakeBus) -> None:
    segment = make_bus()
    writer, ring = AlarmWriter(segment, "writer"), open_alarm_ring(segment, "writer")
    writer.raise_alarm(7, Alarm.GAP, 3, 2.0, since=5)
    for other in ("clock", "reader"):
        AlarmWriter(segment, other).raise_alarm(9, Alarm.LATE)
    # A restarted task continues its ring.
    AlarmWriter(segment, "writer").raise_alarm(8, Alarm.STALE)
    rows, lost = ring.read_new_rows()
    assert not lost
    found = [tuple(rows[name].tolist()) for name in ("tick", "code", "subject", "value", "since")]
    assert found == [(7, 8), (Alarm.GAP, Alarm.STALE), (3, -1), (2.0, 0.0), (5, 8)]
    assert rows["time_ns"][0] <= rows["time_ns"][1]


def test_an_alarm_wakes_the_rack_and_a_miss_does_not(make_bus: MakeBus) -> None:
    segment, attention = make_bus(), os.eventfd(0, os.EFD_NONBLOCK)
    try:
        writer = AlarmWriter(segment, "writer", attention)
        for code in Alarm:
            writer.raise_alarm(0, code)
        assert os.eventfd_read(attention) == len(Alarm) - len(MISSES)
    finally:
        os.close(attention)


@pytest.fixture
def episodes(make_bus: MakeBus) -> tuple[Episodes, Ring]:
    """Episodes about the second of two mailboxes, and the ring of the task that finds them."""
    other, box = mailbox(name="writer.other"), mailbox(every=EVERY, delay=EVERY)
    segment = make_bus(other, box)
    return Episodes(segment, box.name, AlarmWriter(segment, "reader")), open_alarm_ring(
        segment, "reader"
    )


def rung(ring: Ring) -> list[tuple[int, int, float, int]]:
    """Return code, tick, value and since of the alarms since the last call, all about mailbox 1."""
    rows = ring.read_new_rows().rows
    assert set(rows["subject"].tolist()) <= {1}
    return list(rows[["code", "tick", "value", "since"]].tolist())


def test_a_finding_that_lasts_raises_one_alarm_with_what_was_found(
    episodes: tuple[Episodes, Ring],
) -> None:
    found, ring = episodes
    found.record_finding(Alarm.STALE, 1, 10)
    found.record_finding(Alarm.STALE, 2, 11, 5.0, since=3)
    found.record_finding(Alarm.GAP, 2, 11, 5.0, since=3)
    assert rung(ring) == [(Alarm.STALE, 10, 0.0, 10), (Alarm.GAP, 11, 5.0, 3)]


@pytest.mark.parametrize(
    ("accesses", "ticks", "is_open"),
    [
        (CLEAN_READS, 1000, True),
        (CLEAN_READS + 1, CLEAN_READS * EVERY, True),
        (CLEAN_READS + 1, CLEAN_READS * EVERY + 1, False),
    ],
)
def test_an_episode_ends_after_both_enough_clean_accesses_and_cycles_of_the_writer(
    episodes: tuple[Episodes, Ring], accesses: int, ticks: int, is_open: bool
) -> None:
    found, ring = episodes
    found.record_finding(Alarm.STALE, 1, 10)
    # The later finding counts from now on.
    found.record_finding(Alarm.STALE, 7, 30)
    assert found.is_open(Alarm.STALE, 7 + accesses, 30 + ticks) is is_open
    assert not found.is_open(Alarm.GAP, 7, 30)
    rung(ring)
    found.record_finding(Alarm.STALE, 7 + accesses, 30 + ticks)
    assert len(rung(ring)) == (0 if is_open else 1)
