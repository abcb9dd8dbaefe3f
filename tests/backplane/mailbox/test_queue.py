"""Queues: each message once and in order, whoever is killed and whatever is damaged."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, SLOT_HEAD_SIZE, compute_slot_stride
from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.mailbox.protocols import open_observer, open_reader, open_writer
from rack.backplane.mailbox.queue import QueueReader, QueueWriter, get_position_mailbox
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot
from tests.backplane.bus import NAME, message_address, queue
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)


def ends(segment: Segment) -> tuple[QueueWriter, QueueReader]:
    writer, reader = open_writer(segment, NAME), open_reader(segment, NAME)
    assert isinstance(writer, QueueWriter)
    assert isinstance(reader, QueueReader)
    return writer, reader


def queue_message(writer: QueueWriter, serial: int) -> bool:
    writer.message.id, writer.message.row = serial, serial
    return writer.send()


def send(writer: QueueWriter, tick: int, *serials: int, now: int | None = None) -> list[bool]:
    """Send these messages in the cycle of a tick, and write them; return the verdicts."""
    verdicts = [queue_message(writer, serial) for serial in serials]
    writer.write(tick, now)
    return verdicts


def ids(reading: Reading) -> list[int]:
    """Return the messages that a read has taken, oldest first; each must be whole."""
    if not reading.is_new:
        assert not reading.earlier
        return []
    found = [*reading.earlier, reading.message]
    assert all((message.row == message.id).all() for message in found)
    return [message.id for message in found]


def test_several_messages_of_a_cycle_are_read_in_order(make_bus: MakeBus) -> None:
    writer, reader = ends(make_bus(*queue(8)))
    assert reader.read(0).verdict is Verdict.NONE
    assert send(writer, 0, 1, 2, 3) == [True] * 3
    assert ids(reader.read(0)) == []
    assert ids(reader.read(1)) == [1, 2, 3]
    again = reader.read(2)
    assert (again.verdict, again.message.id, again.earlier) == (Verdict.OLD, 3, ())


def test_reader_takes_no_more_than_it_has_room_for(make_bus: MakeBus) -> None:
    writer, reader = ends(make_bus(*queue(8)))
    send(writer, 0, 1, 2, 3, 4)
    for tick, most, taken in ((1, 0, []), (2, 1, [1]), (3, 2, [2, 3]), (4, -1, []), (5, 9, [4])):
        assert ids(reader.take_messages(tick, most)) == taken


def test_a_full_queue_refuses_messages_and_keeps_the_unread_ones(make_bus: MakeBus) -> None:
    segment = make_bus(*queue(3))
    writer, reader = ends(segment)
    assert writer.count_free_places() == 3
    assert send(writer, 0, 1, 2) == [True, True]
    assert send(writer, 1, 3, 4) == [True, False]
    assert (writer.count_free_places(), writer.refused) == (0, 1)
    assert open_observer(segment, NAME).slots.box[Box.REFUSED] == 1
    assert ids(reader.read(2)) == [1, 2, 3]
    assert send(writer, 2, 5) == [False]
    writer.position.message.taken = 3
    assert send(writer, 3, 6) == [True]
    assert ids(reader.read(4)) == [6]


def test_messages_of_a_cycle_are_published_together_or_not_at_all(make_bus: MakeBus) -> None:
    segment = make_bus(*queue(8))

    def die() -> None:
        writer = QueueWriter(segment, NAME)
        send(writer, 0, 1, 2)
        for serial in (3, 4):
            queue_message(writer, serial)
        for _ in writer.iterate_outgoing():
            # Killed before they are shown.
            writer.publish_message(1, 2, 1)

    assert exit_status(fork(die)) == 0
    writer, reader = ends(segment)
    assert ids(reader.read(9)) == [1, 2]
    assert send(writer, 9, 5) == [True]
    assert ids(reader.read(10)) == [5]


@pytest.mark.parametrize(("now", "in_time"), [(None, True), (7, True), (8, False)])
def test_a_late_write_becomes_visible_at_the_next_boundary(
    make_bus: MakeBus, now: int | None, in_time: bool
) -> None:
    writer, reader = ends(make_bus(*queue(4, rates=(4, 1))))
    assert writer.write(4, now)  # nothing to write is never late
    assert queue_message(writer, 1)
    assert writer.write(4, now) is in_time
    assert [ids(reader.read(tick)) for tick in (7, 8, 12)] == [[], [1][:in_time], [1][in_time:]]


def test_an_observer_takes_no_message_from_a_queue(make_bus: MakeBus) -> None:
    segment = make_bus(*queue(8))
    writer, reader = ends(segment)
    send(writer, 0, 1, 2)
    observer = open_observer(segment, NAME)
    assert (observer.peek().message.id, observer.read(1).message.id) == (2, 2)
    assert ids(reader.read(1)) == [1, 2]
    send(writer, 1, 3, 4, 5)
    send(writer, 2, 6)
    reader.take_messages(2, 1)
    reader.close()
    # A restarted reader still has the last message taken as an old one.
    writer.close()
    reader = QueueReader(segment, NAME)
    again = reader.take_messages(3, 0)
    assert (again.verdict, again.message.id) == (Verdict.OLD, 3)
    # Its position counts the messages left.
    position = open_observer(segment, get_position_mailbox(NAME)).peek().message
    assert (position.taken, position.unread) == (3, 3)


def test_a_lost_message_is_found_at_its_tick_even_without_a_later_one(make_bus: MakeBus) -> None:
    writer, reader = ends(make_bus(*queue(1, rates=(4, 1))))
    writer.compute_visible_tick(0, None)
    writer.lose_message()
    writer.show_published()
    assert writer.count_free_places() == 0
    assert [reader.read(tick).is_new or reader.statistics.lost for tick in (0, 3, 4)] == [0, 0, 1]
    assert reader.taken == 1
    writer.position.message.taken = reader.taken
    assert send(writer, 8, 2) == [True]
    assert ids(reader.read(12)) == [2]


@pytest.mark.parametrize("word", range(8))
@pytest.mark.parametrize("at", [1, 3])
def test_no_damage_to_a_slot_holds_up_the_queue(make_bus: MakeBus, word: int, at: int) -> None:
    segment = make_bus(*queue(3))
    writer, reader = ends(segment)
    send(writer, 0, 1, 2, 3)
    words = segment.words[(message_address(segment, at) - SLOT_HEAD_SIZE) // 8 :]
    words[word] ^= 1 << 40
    found = ids(reader.read(1))
    # The checksum does not cover the time stamp.
    assert found == [serial for serial in (1, 2, 3) if serial != at or word == Slot.STAMP_NS]
    assert reader.statistics.bad_reads == (word != Slot.STAMP_NS)
    assert reader.taken == 3
    writer.position.message.taken = reader.taken
    assert send(writer, 1, 4) == [True]
    assert ids(reader.read(2)) == [4]


def bookkeeping(segment: Segment) -> Iterator[int]:
    """Yield the addresses of the heads of a queue, of its position, and of the slots in use of
    both."""
    for name, serials in ((NAME, range(1, 6)), (get_position_mailbox(NAME), range(1, 3))):
        start = segment.map.mailboxes[name]
        yield from range(start, start + MAILBOX_HEAD_SIZE)
        for serial in serials:
            message = message_address(segment, serial, name)
            # The position is part of its message.
            stride = compute_slot_stride(segment.layout.find_mailbox(name))
            size = SLOT_HEAD_SIZE if name == NAME else stride
            yield from range(message - SLOT_HEAD_SIZE, message - SLOT_HEAD_SIZE + size)


@pytest.mark.slow
@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.thorough), 3])
def test_no_flipped_bit_lets_a_restarted_reader_take_a_message_twice(
    make_bus: MakeBus, step: int
) -> None:
    segment = make_bus(*queue(8))
    send(QueueWriter(segment, NAME), 0, 1, 2, 3, 4, 5)

    def take_three() -> None:
        reader = QueueReader(segment, NAME)
        assert [ids(reader.take_messages(1, 2)), ids(reader.take_messages(2, 1))] == [[1, 2], [3]]
        os.kill(os.getpid(), signal.SIGKILL)

    assert exit_status(fork(take_three)) == -signal.SIGKILL
    before = bytes(segment.bytes)
    bits = [(address, bit) for address in bookkeeping(segment) for bit in range(8)]
    for address, bit in bits[::step]:
        segment.bytes[:] = before
        segment.bytes[address] ^= 1 << bit
        reader = QueueReader(segment, NAME)
        found = [*ids(reader.take_messages(3, 1)), *ids(reader.read(4))]
        damaged, counted = f"bit {bit} at {address}", reader.statistics.bad_reads
        reader.close()
        assert found == [serial for serial in (4, 5) if serial in found], damaged
        # What is not counted as lost is still in the queue, to be shown again by the next message.
        assert len(found) + counted + max(0, 5 - reader.taken) >= 2, damaged
