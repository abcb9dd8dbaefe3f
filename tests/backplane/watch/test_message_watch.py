"""Checks on messages: no alarm for a slow machine, and one alarm per episode for each fault."""

from __future__ import annotations

import pytest

from rack.backplane.layout import PROTOCOLS, TICK_PROTOCOLS, Protocol
from rack.backplane.watch.alarms import Alarm
from tests.backplane.bus import NAME, message_address
from tests.link import Link, MakeLink, ReadingTask, WritingTask


def publish(rack: Link, tick: int, visible_at: int) -> None:
    """Publish a message without its task."""
    writer = rack.writer.ports.writers["point"]
    writer.message.id = tick
    writer.message.row = tick
    writer.publish_message(tick, visible_at, tick)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_reader_that_skips_cycles_reports_nothing_false(
    link: MakeLink, protocol: Protocol
) -> None:
    # The last pause is long enough for everything to be overwritten.
    rack = link(protocol)
    for pause in (1, 2, 18, 100):
        start = rack.reader.seen[-1].tick + 1 if rack.reader.seen else 0
        rack.run(start, start + 30)
        rack.run(start + 30, start + 30 + pause, reads=False)
        rack.run(start + 30 + pause, start + 60 + pause)
    assert rack.alarms() == []
    assert not any(seen.is_lost for seen in rack.reader.seen)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("late", [1, 2, 18])
def test_a_writer_that_is_late_or_skips_cycles_is_no_fault(
    link: MakeLink, protocol: Protocol, late: int
) -> None:
    rack = link(protocol)
    rack.run(0, 20)
    rack.run(20, 20 + late, writes=False)
    # Released at 20, finished at 20 + late: the releases in between are skipped.
    rack.writer.cycle(20, now=20 + late)
    rack.run(20 + late, 80)
    assert rack.alarms() == []


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_restarted_reader_reports_nothing_false(link: MakeLink, protocol: Protocol) -> None:
    rack = link(protocol)
    rack.run(0, 50)
    rack.run(50, 450, reads=False)
    rack.reader = ReadingTask(rack.segment)
    rack.run(450, 500)
    assert rack.alarms() == []
    assert not any(seen.is_lost for seen in rack.reader.seen)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("published", [False, True])
def test_a_restarted_writer_is_not_taken_for_a_fault(
    link: MakeLink, protocol: Protocol, published: bool
) -> None:
    rack = link(protocol)
    rack.run(0, 50)
    if published:
        # Killed after its write, before the end of its cycle.
        publish(rack, 50, 51)
    rack.writer.close()
    rack.run(50, 250, writes=False)
    rack.writer = WritingTask(rack.segment)
    rack.run(250, 300)
    assert rack.alarms() == []
    assert rack.alarms("writer") == []
    assert rack.reader.seen[-1].released == 299 - (protocol in TICK_PROTOCOLS)


@pytest.mark.parametrize("rates", [(1, 8), (1, 24)])
def test_a_slow_reader_finds_damage_in_messages_it_skips(
    link: MakeLink, rates: tuple[int, int]
) -> None:
    rack = link(rates=rates)
    rack.run(0, 97)
    rack.writer.cycle(97)
    # The message of tick 97: its reader takes a later one.
    rack.segment.bytes[message_address(rack.segment, 98, NAME) + 9] ^= 4
    rack.run(98, 121)
    assert rack.reader.ports.corrupt == 0
    assert [code for _, code in rack.alarms()] == [Alarm.DAMAGED]


def test_a_slot_whose_head_is_damaged_is_damaged_and_not_lost(link: MakeLink) -> None:
    rack = link(rates=(1, 8))
    rack.run(0, 20)
    for at in range(-64, 0):
        rack.segment.bytes[message_address(rack.segment, 19) + at] ^= 0x80
    rack.run(20, 40)
    assert [code for _, code in rack.alarms()] == [Alarm.DAMAGED]


@pytest.mark.parametrize(
    ("messages", "alarms"), [(2, []), (3, [Alarm.BABBLE]), (5, [Alarm.BABBLE])]
)
def test_one_message_more_than_releases_is_no_babble(
    link: MakeLink, messages: int, alarms: list[Alarm]
) -> None:
    rack = link()
    rack.run(0, 20)
    rack.reader.cycle(20)
    for _ in range(messages):
        publish(rack, 20, 21)
    if messages == 5:
        # Serials begin at 1: 21 to 25 are the babble, whose single messages are not judged.
        rack.segment.bytes[message_address(rack.segment, 23)] ^= 4
    rack.reader.cycle(21)
    assert [code for _, code in rack.alarms()] == alarms


@pytest.mark.parametrize("every", [1, 4])
def test_a_lost_message_is_missing_from_the_tick_at_which_it_would_be_visible(
    link: MakeLink, every: int
) -> None:
    rack = link(rates=(every, 1))
    rack.run(0, 8 * every)
    writer = rack.writer.ports.writers["point"]
    writer.lose_message()
    found = {}
    for tick in range(8 * every, 12 * every):
        rack.reader.cycle(tick)
        if alarms := rack.alarms():
            found[tick] = alarms
        if tick == 9 * every:
            rack.writer.cycle(tick)
    # Written at 8 cycles, visible one later.
    assert found == {9 * every: [(9 * every, Alarm.GAP)]}
