"""Slots of a mailbox: copies of their content."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.protocols import open_observer, open_writer
from rack.backplane.mailbox.slots import Slots
from rack.backplane.segment import Segment
from tests.backplane.bus import NAME, mailbox, message_address
from tests.backplane.conftest import MakeBus

DEPTH = 8


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    """Five messages, each with its serial as its id."""
    segment = make_bus(mailbox(depth=DEPTH))
    writer = open_writer(segment, NAME)
    for serial in range(1, 6):
        writer.message.id = serial
        writer.write(serial)
    writer.close()
    return segment


def between(bus: Segment, before: int, newest: int) -> list[int]:
    reader = open_observer(bus, NAME)
    reader.serial = newest
    earlier = reader.add_earlier(reader.get_reading(True), before).earlier
    return [int(message.id) for message in earlier]


def test_between_two_serials_each_good_message_is_copied(bus: Segment) -> None:
    assert between(bus, 1, 5) == [2, 3, 4]
    assert between(bus, 4, 5) == []
    bus.bytes[message_address(bus, 3)] ^= 1
    assert between(bus, 1, 5) == [2, 4]
    writer = open_writer(bus, NAME)
    for serial in range(6, 4 + DEPTH):
        writer.message.id = serial
        writer.write(serial)
    # Older slots were used again.
    assert between(bus, 1, 3 + DEPTH) == [4, *range(5, 3 + DEPTH)]


def test_a_slot_that_is_used_again_is_not_kept(bus: Segment) -> None:
    slots = Slots(bus, bus.layout.find_mailbox(NAME))
    assert [slots.copy_slot(serial) for serial in (1, 5)] == [True, True]
    writer = open_writer(bus, NAME)
    for serial in range(6, 2 + DEPTH):
        writer.write(serial)
    assert [slots.copy_slot(serial) for serial in (1, 5)] == [False, True]
