"""The ring of a host board: bounded, first in first out, checked by its reader."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.mailbox.host_ring import HostReader, HostWriter, ProperContent
from rack.backplane.message import Message
from rack.backplane.segment import Segment
from rack.boards.config.layout import field_specs
from tests.backplane.bus import NAME, mailbox, message_address
from tests.backplane.conftest import MakeBus
from tests.boards.host_programs import NUMBER

CAPACITY = 5


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    """A bus with one ring of `CAPACITY` messages in 8 slots."""
    return make_bus(mailbox("queue", capacity=CAPACITY))


def send(writer: HostWriter, number: int) -> bool:
    writer.message.id = number
    return writer.send(tick=number)


def taken(reader: HostReader) -> list[int | None]:
    """Take all that waits; None stands for a message refused."""
    found = []
    while reader.waiting:
        message = reader.take()
        found.append(None if message is None else int(message.id))
    return found


def test_messages_come_once_and_in_order(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    assert [send(writer, number) for number in (1, 2, 3)] == [True] * 3
    assert (reader.waiting, taken(reader), reader.waiting, reader.written) == (3, [1, 2, 3], 0, 3)
    send(writer, 4)
    assert taken(reader) == [4]


def test_a_full_ring_refuses_and_loses_nothing_that_waits(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    sent = [send(writer, number) for number in range(1, 9)]
    assert sent == [True] * CAPACITY + [False] * 3
    assert (reader.full, reader.waiting) == (3, CAPACITY)
    reader.take()
    assert send(writer, 9)
    assert taken(reader) == [2, 3, 4, 5, 9]


def test_the_newest_overtakes_the_others(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    for number in (1, 2, 3):
        send(writer, number)
    message = reader.take_newest(most=8)
    assert message is not None
    assert (message.id, reader.overtaken, reader.waiting) == (3, 2, 0)
    assert reader.take_newest(most=8) is None


def test_a_reader_that_is_restarted_goes_on_where_the_first_was(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    for number in (1, 2, 3):
        send(writer, number)
    reader.take()
    assert taken(HostReader(segment, NAME)) == [2, 3]


def test_a_damaged_message_is_refused_and_the_next_one_is_not(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    for number in (1, 2, 3):
        send(writer, number)
    segment.bytes[message_address(segment, 2)] ^= 1
    assert (taken(reader), reader.refused) == ([1, None, 3], 1)


def test_a_writer_that_keeps_to_no_bound_overwrites_what_waits_and_is_counted(segment: Segment) -> None:
    writer, reader = HostWriter(segment, NAME), HostReader(segment, NAME)
    for number in range(1, 21):
        writer.message.id = number
        writer.write(tick=number)
    found = taken(reader)
    assert found == list(range(14, 21))
    assert (reader.overtaken, reader.refused) == (13, 0)


def test_numbers_that_are_nan_and_unknown_members_of_enums_are_improper() -> None:
    check, message = ProperContent(field_specs(NUMBER, {})), Message(NUMBER.dtype({}))
    assert check(message)
    message.value = np.inf
    assert check(message)
    message.colour = 2
    assert not check(message)
    message.colour, message.value = 1, np.nan
    assert not check(message)
