"""The ring of a host board: bounded, first in first out, checked by its reader."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.mailbox.host_ring import HostReader, HostWriter, has_permitted_values
from rack.backplane.message import AnyMessage
from rack.backplane.message_type import Field, MessageType
from rack.backplane.segment import Segment
from rack.boards.config.layout import build_field_specs
from tests.backplane.bus import NAME, mailbox, message_address
from tests.backplane.conftest import MakeBus
from tests.boards.host_programs import Number

CAPACITY = 5
Ends = tuple[HostWriter, HostReader]


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    """A bus with one ring of `CAPACITY` messages in 8 slots."""
    return make_bus(mailbox("queue", capacity=CAPACITY))


@pytest.fixture
def ends(segment: Segment) -> Ends:
    return HostWriter(segment, NAME), HostReader(segment, NAME)


def send(writer: HostWriter, number: int) -> bool:
    writer.message.id = number
    return writer.send_message(tick=number)


def taken(reader: HostReader) -> list[int | None]:
    """Take all that waits; None stands for a message refused."""
    found = []
    while reader.waiting_count:
        message = reader.take_oldest()
        found.append(None if message is None else int(message.id))
    return found


def test_messages_come_once_and_in_order(ends: Ends, segment: Segment) -> None:
    writer, reader = ends
    assert [send(writer, number) for number in (1, 2, 3)] == [True] * 3
    assert reader.waiting_count == 3
    assert (taken(reader), reader.waiting_count, reader.written_tick) == ([1, 2, 3], 0, 3)
    for number in (4, 5, 6):
        send(writer, number)
    reader.take_oldest()
    # A restarted reader goes on where the first one was.
    assert taken(HostReader(segment, NAME)) == [5, 6]


def test_a_full_ring_refuses_messages_and_keeps_the_waiting_ones(ends: Ends) -> None:
    writer, reader = ends
    assert [send(writer, number) for number in range(1, 9)] == [True] * CAPACITY + [False] * 3
    assert (reader.full_count, reader.waiting_count) == (3, CAPACITY)
    reader.take_oldest()
    assert send(writer, 9)
    assert taken(reader) == [2, 3, 4, 5, 9]


def test_the_newest_message_supersedes_the_others(ends: Ends) -> None:
    writer, reader = ends
    for number in (1, 2, 3):
        send(writer, number)
    message = reader.take_newest(most=8)
    assert message is not None
    assert (message.id, reader.superseded, reader.waiting_count) == (3, 2, 0)
    assert reader.take_newest(most=8) is None


def test_a_damaged_message_is_refused_and_the_next_one_is_not(ends: Ends, segment: Segment) -> None:
    writer, reader = ends
    for number in (1, 2, 3):
        send(writer, number)
    segment.bytes[message_address(segment, 2)] ^= 1
    assert (taken(reader), reader.refused) == ([1, None, 3], 1)


def test_messages_overwritten_by_an_unbounded_writer_are_counted(ends: Ends) -> None:
    writer, reader = ends
    for number in range(1, 21):
        writer.message.id = number
        writer.write(tick=number)
    assert taken(reader) == list(range(14, 21))
    assert (reader.superseded, reader.refused) == (13, 0)


def test_undeclared_lengths_and_non_ascii_texts_are_improper_but_empty_groups_are_not() -> None:
    fields, message = build_field_specs(Number.message_type, {}), Number.zeros({})
    for value, colour, permitted in ((0.0, 0, True), (0.0, 2, False), (np.nan, 1, False)):
        message.value, message.colour = value, colour
        assert has_permitted_values(message.record, fields) is permitted
    turn = Field("turn", "f8", "1", "unit", (2,), (0.9, 1.1))
    one = MessageType("one", 1, (Field("name", "S4", "ASCII", "its name"), turn))
    kind = MessageType(
        "all",
        1,
        (Field("ones", one, "1", "them", (3,)), Field("far", "f4", "m", "", (), (0.0, 5.0))),
    )
    fields, message = build_field_specs(kind, {}), AnyMessage(kind.build_dtype({}))
    assert has_permitted_values(message.record, fields)
    for far, permitted in ((5.0, True), (-5.0, True), (5.1, False), (-5.1, False), (0.0, True)):
        message.far = far
        assert has_permitted_values(message.record, fields) is permitted
    first = message.ones[0]
    first["name"] = b"a"
    assert not has_permitted_values(message.record, fields)
    big = np.finfo(float).max
    for turned, permitted in (
        ((0.6, 0.8), True),
        ((1.0, 0.8), False),
        ((big, big), False),
        ((0.0, -1.0), True),
    ):
        first["turn"] = turned
        assert has_permitted_values(message.record, fields) is permitted
    first["name"] = b"\xff"
    assert not has_permitted_values(message.record, fields)
