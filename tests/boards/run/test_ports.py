"""Outputs that are not written in every cycle."""

from __future__ import annotations

from rack.backplane.watch.alarms import CLEAN_READS, Alarm
from rack.boards.faults.message_steps import forge_message
from rack.levels.level import Output
from tests.backplane.bus import NAME, Point
from tests.link import MakeLink


def test_a_message_at_its_own_rate_is_visible_at_multiples_of_its_period(link: MakeLink) -> None:
    rack = link(rates=(2, 2), cycles=4)
    rack.run(0, 40)
    assert rack.written() == [(6, 1, 8), (14, 2, 16), (22, 3, 24), (30, 4, 32), (38, 5, 40)]
    assert [seen.tick for seen in rack.reader.seen if seen.verdict == "NEW"] == [8, 16, 24, 32]
    output = Output(Point, cycles=4)
    for phase in (0, 1):
        due = [tick for tick in range(phase, 40, 2) if output.is_due(tick, 2, phase)]
        assert due == list(range(6 + phase, 40, 8))


def test_between_its_messages_a_slow_output_raises_no_alarm(link: MakeLink) -> None:
    rack = link(rates=(1, 1), cycles=8)
    rack.run(0, 200)
    assert rack.alarms() == []
    assert not any(seen.is_lost for seen in rack.reader.seen)


def test_a_slow_output_that_stops_is_mute_after_three_of_its_periods(link: MakeLink) -> None:
    rack = link(cycles=8)
    rack.run(0, 64)
    rack.fault("mute")
    rack.run(64, 160)
    ((tick, alarm),) = rack.alarms()
    assert alarm is Alarm.MUTE
    assert 63 + 3 * 8 <= tick <= 63 + 4 * 8


def test_a_writer_reports_a_forged_message_once_per_episode(
    link: MakeLink,
) -> None:
    rack = link()
    rack.run(0, 10)
    rung = []
    for first in (10, 10 + 3 * CLEAN_READS):
        # What another process writes shows at the task's next message.
        for tick in (first, first + 1):
            forge_message(rack.segment, NAME, tick)
            rack.writer.cycle(tick)
        for tick in range(first + 2, first + 3 * CLEAN_READS):
            rack.writer.cycle(tick)
        rung.append([code for _, code in rack.alarms("writer")])
    assert rung == [[Alarm.MASQUERADE]] * 2
