"""Checks on silence: an alarm needs proof; silence alone is a reason to hold."""

from __future__ import annotations

import os
import signal

import pytest

from rack.backplane.layout import PROTOCOLS, Protocol
from rack.backplane.process import read_state
from rack.backplane.trace import Flag
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block
from tests.backplane.bus import NAME
from tests.link import MakeLink, WritingTask
from tests.processes import FORKS, forked, kill, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_writer_that_is_only_late_is_neither_mute_nor_stale(
    link: MakeLink, protocol: Protocol
) -> None:
    rack = link(protocol)
    rack.run(0, 20)
    # The clock may say for a lost task that it has finished.
    rack.segment.get_block("writer")[Block.DONE] = 25
    rack.run(20, 60, writes=False)
    assert rack.alarms() == []
    # But its reader holds: a cycle and the slice are permitted, three more are not.
    age = 3 + rack.segment.layout.find_mailbox(NAME).delay
    assert [seen.tick for seen in rack.reader.seen if seen.is_lost] == [*range(19 + age, 60)]


def test_a_writer_that_finishes_cycles_without_a_message_is_mute(link: MakeLink) -> None:
    rack = link()
    rack.run(0, 20)
    for begin in (20, 40):
        # The next good message ends the episode, and the next silence is another.
        for tick in range(begin, begin + 10):
            rack.writer.end(tick)
            rack.reader.cycle(tick)
        assert rack.alarms() == [(begin + 2, Alarm.MUTE)]
        rack.run(begin + 10, begin + 20)


def test_a_write_that_timed_out_at_a_lock_is_not_mute(link: MakeLink) -> None:
    rack = link("lock")
    rack.run(0, 20)
    for tick in range(20, 30):
        rack.writer.end(tick, int(Flag.BUS_ERROR))
        rack.reader.cycle(tick)
    assert rack.alarms() == []


@pytest.mark.parametrize(("number", "state"), [(signal.SIGSTOP, "T"), (signal.SIGKILL, "Z")])
def test_a_message_whose_writer_is_dead_or_stopped_is_stale(
    link: MakeLink, number: signal.Signals, state: str
) -> None:
    rack = link()
    rack.writer.close()

    def write() -> None:
        writer = WritingTask(rack.segment)
        for tick in range(20):
            writer.cycle(tick)
        signal.pause()

    with forked(write) as pid:
        wait_until(lambda: rack.segment.get_block("writer")[Block.DONE] == 19)
        rack.run(19, 30, writes=False)
        assert rack.alarms() == []
        os.kill(pid, number)
        wait_until(lambda: read_state(pid) == state)
        rack.run(30, 40, writes=False)
        assert rack.alarms() == [(30, Alarm.STALE)]
        kill(pid)
    rack.writer = WritingTask(rack.segment)
    rack.run(40, 60)
    assert rack.alarms() == []


def test_a_marked_loss_shows_from_the_next_tick(link: MakeLink) -> None:
    rack = link()
    rack.run(0, 20)
    rack.segment.get_block("writer")[Block.LOST] = 1 + 20
    assert [rack.reader.cycle(tick).is_lost for tick in (20, 21, 22)] == [False, True, True]
    rack.segment.get_block("writer")[Block.LOST] = 0
    assert not rack.reader.cycle(22).is_lost


def test_a_lost_writer_that_never_wrote_does_not_count_as_lost(link: MakeLink) -> None:
    rack = link()
    rack.segment.get_block("writer")[Block.LOST] = 1
    assert not rack.reader.cycle(5).is_lost
    assert not rack.reader.cycle(500).is_lost


@pytest.mark.parametrize("rates", [(1, 1), (1, 8), (8, 1)])
def test_after_a_pause_of_the_clock_no_writer_is_silent(
    link: MakeLink, rates: tuple[int, int]
) -> None:
    rack = link(rates=rates)
    rack.run(0, 80)
    # It skipped 40 ticks: no task was released, and every message is old.
    rack.run(120, 200)
    assert rack.alarms() == []
    assert not any(seen.is_lost for seen in rack.reader.seen)


def test_a_message_that_was_due_in_a_pause_of_the_clock_was_not_suppressed(
    link: MakeLink,
) -> None:
    # Written in each eighth cycle of its writer, as scenes are.
    rack = link(cycles=8)
    rack.run(0, 80)
    # Those of ticks 87, 95 and 103 are skipped; the next is of 111.
    # A release that falls into the pause is made up for, with its tick.
    rack.writer.end(104)
    rack.reader.cycle(100)
    rack.run(105, 130)
    assert rack.alarms() == []
    for tick in range(130, 180):
        rack.writer.end(tick)
        rack.reader.cycle(tick)
    # The newest is of tick 127: three of its periods later.
    assert rack.alarms() == [(151, Alarm.MUTE)]


def test_a_pause_does_not_hide_a_writer_that_stays_away(link: MakeLink) -> None:
    rack = link()
    rack.run(0, 20)
    assert [rack.reader.cycle(tick).is_lost for tick in range(60, 70)] == [False] * 4 + [True] * 6
