"""Reading a mailbox of the clock: silence is not a fault; a damaged or forged message is."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.slots import build_signature
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import MailboxWatcher, open_watched
from rack.backplane.words import Slot
from tests.backplane.bus import mailbox, message_address
from tests.backplane.conftest import MakeBus

BOX = "reader.operator"


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox(), mailbox(name=BOX, writer="clock"))


@pytest.fixture
def writer(segment: Segment) -> Iterator[Writer]:
    made = Writer(segment, BOX)
    yield made
    made.close()


def open_reader(segment: Segment, name: str = BOX) -> MailboxWatcher:
    return open_watched(segment, name, AlarmWriter(segment, "reader"), ReadingTask())


def rung(segment: Segment) -> list[Alarm]:
    return [
        Alarm(int(row["code"])) for row in open_alarm_ring(segment, "reader").read_new_rows().rows
    ]


def test_silence_is_no_loss(segment: Segment, writer: Writer) -> None:
    reader = open_reader(segment)
    assert not reader.read(5).has_message
    # Several messages of one tick are no babble.
    for number in range(3, 8):
        writer.message.id = number
        writer.write(10)
    assert not reader.read(10).has_message
    assert reader.read(11).is_new
    late = reader.read(10_000)
    assert (late.message.id, late.is_lost, late.is_new) == (7, False, False)
    assert rung(segment) == []


def test_a_damaged_message_is_rejected_and_reported(segment: Segment, writer: Writer) -> None:
    task = ReadingTask()
    reader = open_watched(segment, BOX, AlarmWriter(segment, "reader"), task)
    for number in (1, 2):
        writer.message.id = number
        writer.write(10 * number)
    segment.bytes[message_address(segment, 2, BOX)] ^= 1
    assert reader.read(30).message.id == 1
    assert rung(segment) == [Alarm.DAMAGED]
    assert task.troubles == 1
    # The next good one is no trouble.
    writer.message.id = 3
    writer.write(40)
    assert reader.read(50).message.id == 3
    assert (task.troubles, rung(segment)) == (1, [Alarm.DAMAGED])


def test_a_forged_message_is_rejected_and_reported(segment: Segment, writer: Writer) -> None:
    reader = open_reader(segment)
    writer.message.id = 1
    writer.write(10)
    assert reader.read(11).message.id == 1
    # A process without the claim signs as another process.
    writer.slots.words[Slot.EPOCH] = build_signature(1, os.getpid() + 1)
    writer.message.id = 2
    writer.write(20)
    assert reader.read(21).message.id == 1
    assert rung(segment) == [Alarm.MASQUERADE]
