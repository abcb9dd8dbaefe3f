"""Alarm rings: every alarm once, in order, and a writer that never waits."""

from __future__ import annotations

import os

from rack.backplane.address_map import ALARM_DEPTH
from rack.backplane.watch.alarms import MISSES, Alarm, AlarmWriter, alarm_ring
from tests.backplane.conftest import MakeBus


def test_alarms_are_read_as_they_were_rung(make_bus: MakeBus) -> None:
    segment = make_bus()
    writer, ring = AlarmWriter(segment, "writer"), alarm_ring(segment, "writer")
    writer.ring(7, Alarm.GAP, 3, 2.0, since=5)
    writer.ring(8, Alarm.STALE)
    rows, lost = ring.drain()
    assert not lost
    found = [tuple(rows[name].tolist()) for name in ("tick", "code", "subject", "value", "since")]
    assert found == [(7, 8), (Alarm.GAP, Alarm.STALE), (3, -1), (2.0, 0.0), (5, 8)]
    assert rows["time_ns"][0] <= rows["time_ns"][1]


def test_each_task_and_the_clock_has_a_ring_of_its_own(make_bus: MakeBus) -> None:
    segment = make_bus()
    names = ("clock", "writer", "reader")
    rings = {name: alarm_ring(segment, name) for name in names}
    for code, name in enumerate(names, 1):
        AlarmWriter(segment, name).ring(code, Alarm(code))
    assert {name: ring.drain().rows["code"].tolist() for name, ring in rings.items()} == {
        name: [code] for code, name in enumerate(names, 1)
    }


def test_a_restarted_task_continues_its_ring(make_bus: MakeBus) -> None:
    segment = make_bus()
    ring = alarm_ring(segment, "writer")
    for tick in (1, 2):
        AlarmWriter(segment, "writer").ring(tick, Alarm.LATE)
    assert ring.drain().rows["tick"].tolist() == [1, 2]


def test_unread_alarms_are_counted(make_bus: MakeBus) -> None:
    segment = make_bus()
    writer, ring = AlarmWriter(segment, "writer"), alarm_ring(segment, "writer")
    for tick in range(2 * ALARM_DEPTH):
        writer.ring(tick, Alarm.LATE)
    rows, lost = ring.drain()
    assert len(rows) + lost == 2 * ALARM_DEPTH
    assert rows["tick"][-1] == 2 * ALARM_DEPTH - 1


def test_an_alarm_wakes_the_rack_and_a_miss_does_not(make_bus: MakeBus) -> None:
    segment, attention = make_bus(), os.eventfd(0, os.EFD_NONBLOCK)
    try:
        writer = AlarmWriter(segment, "writer", attention)
        for code in Alarm:
            writer.ring(0, code)
        assert os.eventfd_read(attention) == len(Alarm) - len(MISSES)
    finally:
        os.close(attention)
