"""A watched queue: faults reported about its messages, and the loss of its writer."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.queue import QueueWriter
from rack.backplane.ring import Ring
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import WatchedQueue, open_watched
from rack.backplane.words import Block
from tests.backplane.bus import NAME, message_address, queue
from tests.backplane.conftest import MakeBus

CAPACITY = 4


class Site:
    """A queue with its writer, its watched reader, and the ring of the reader's alarms."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.writer = QueueWriter(segment, NAME)
        self.task = ReadingTask()
        self.room = CAPACITY
        found = open_watched(
            segment,
            NAME,
            AlarmWriter(segment, "reader"),
            self.task,
            count_room=lambda: self.room,
        )
        assert isinstance(found, WatchedQueue)
        self.reader = found
        self._ring: Ring = open_alarm_ring(segment, "reader")

    def send(self, tick: int, *numbers: int) -> None:
        """Send messages in a cycle of the writer, which knows what has been taken."""
        self.writer.position.message.taken = self.reader.reader.taken
        for number in numbers:
            self.writer.message.id = number
            assert self.writer.send()
        self.writer.write(tick)

    def read(self, tick: int) -> list[int]:
        """Read at a tick; return the numbers of what was taken."""
        reading = self.reader.read(tick)
        messages = [*reading.earlier, reading.message] if reading.is_new else []
        return [message.id for message in messages]

    def alarms(self) -> list[tuple[int, int, float]]:
        """Return code, tick and value of the alarms since the last call."""
        rows = self._ring.read_new_rows().rows
        return [(int(row["code"]), int(row["tick"]), float(row["value"])) for row in rows]


@pytest.fixture
def site(make_bus: MakeBus) -> Site:
    return Site(make_bus(*queue(CAPACITY)))


def test_messages_in_order_raise_no_alarm(site: Site) -> None:
    taken = []
    for tick in range(0, 40, 2):
        site.send(tick, tick, tick + 1)
        taken += site.read(tick + 1)
    assert taken == list(range(40))
    site.send(40, 1, 2, 3)
    site.room = 2
    assert [site.read(41), site.read(42), site.read(43)] == [[1, 2], [3], []]
    assert (site.alarms(), site.task.troubles) == ([], 0)


def test_a_lost_message_is_reported_as_a_gap_and_counted_as_trouble(site: Site) -> None:
    site.send(0, 1)
    assert site.read(1) == [1]
    site.writer.compute_visible_tick(2, None)
    site.writer.lose_message()
    site.writer.lose_message()
    site.writer.show_published()
    assert site.read(3) == []
    assert (site.alarms(), site.task.troubles) == ([(Alarm.GAP, 3, 2.0)], 1)
    site.send(4, 7)
    assert site.read(5) == [7]
    assert (site.alarms(), site.task.troubles) == ([], 1)


def test_a_damaged_message_is_reported_and_later_messages_are_read(site: Site) -> None:
    site.send(0, 1, 2, 3)
    site.segment.get_bytes(message_address(site.segment, 2), 1)[0] ^= 1
    assert site.read(1) == [1, 3]
    (alarm,) = site.alarms()
    assert alarm[:2] == (Alarm.DAMAGED, 1)
    assert site.task.troubles == 1


@pytest.mark.parametrize(("lost", "at", "is_lost"), [(0, 9, False), (9, 8, False), (9, 9, True)])
def test_a_writer_is_lost_from_the_tick_after_its_loss(
    site: Site, lost: int, at: int, is_lost: bool
) -> None:
    assert not site.reader.read(at).is_lost
    site.segment.get_block("writer")[Block.LOST] = lost
    assert site.reader.read(at).is_lost is is_lost
    assert site.reader.is_writer_lost(at) is is_lost
