"""Operator table: requests are filled completely, wait in order and can be withdrawn."""

from __future__ import annotations

import os
import signal
from contextlib import ExitStack

import pytest

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.errors import OperatorTableError
from rack.backplane.operator_table import (
    OperatorTable,
    Request,
    RequestEntry,
    RequestStage,
)
from rack.backplane.segment import Segment
from rack.backplane.words import System
from tests.backplane.bus import mailbox
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, descriptors, exit_status, fork

BOX = "reader.operator"


@pytest.fixture
def segment(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox(name=BOX, writer="clock"))


def give(entry: RequestEntry, serial: int) -> None:
    """Do to an entry what the clock does."""
    entry.serial, entry.given_tick = serial, 10 * serial
    entry.stage = RequestStage.GIVEN


def test_an_entry_contains_the_request(segment: Segment) -> None:
    message = bytes(range(1, 1 + segment.layout.find_mailbox(BOX).size % 256))
    entry = OperatorTable(segment).add_request(Request(0, message, tick=40))
    read = OperatorTable(segment).entries[entry.index]
    assert bytes(read.message[: len(message)]) == message
    assert (read.mailbox, read.tick) == (0, 40)
    assert (read.stage, read.serial, read.given_tick) == (RequestStage.WAITING, 0, -1)


def test_requests_wait_in_the_order_of_their_arrival(segment: Segment) -> None:
    table = OperatorTable(segment)
    added = [table.add_request(Request(0, b"", tick)) for tick in (9, 3, 5)]
    give(added[0], 1)
    added.append(table.add_request(Request(0, b"", 7)))
    assert [entry.tick for entry in OperatorTable(segment).list_waiting()] == [3, 5, 7]
    assert [entry.ticket for entry in OperatorTable(segment).list_waiting()] == [2, 3, 4]
    assert segment.words[System.REQUESTED] == 4


def test_issued_commands_without_a_waiting_request_by_their_tick_are_missing(
    segment: Segment,
) -> None:
    table = OperatorTable(segment)
    hold, resume = b"\1", b"\2"
    issued = [
        Request(0, message, tick)
        for message, tick in ((hold, 100), (resume, 150), (hold, 200), (hold, 300))
    ]
    assert table.find_missing(issued) == issued
    # Added late, at once, and one that the run did not live to see.
    for message, tick in ((hold, 300), (hold, -1), (resume, 400)):
        table.add_request(Request(0, message, tick))
    assert table.find_missing(issued) == issued[1:3]
    with table.claim_request(Request(0, resume, 150)):
        assert table.find_missing(issued) == issued[2:3]
    # Its client is gone.
    assert table.find_missing(issued) == issued[1:3]


def test_a_request_in_a_reused_entry_is_not_withdrawn_by_an_earlier_client(
    segment: Segment,
) -> None:
    table = OperatorTable(segment)
    entry = table.add_request(Request(0, b"", 9))
    ticket = entry.ticket
    assert table.withdraw_request(entry, ticket)
    assert table.list_waiting() == []
    again = table.add_request(Request(0, b"", 11))
    assert again.index == entry.index
    assert not table.withdraw_request(entry, ticket)
    assert again.stage == RequestStage.WAITING
    give(again, 1)
    assert not table.withdraw_request(again, again.ticket)
    assert again.stage == RequestStage.GIVEN


def test_a_claimed_request_waits_as_long_as_its_client_holds_it(segment: Segment) -> None:
    table, before = OperatorTable(segment), descriptors()
    with table.claim_request(Request(0, b"", 9)) as first:
        assert OperatorTable(segment).list_waiting()[0].index == first.index
    assert table.list_waiting() == []
    # One without a client waits in an entry that a client had.
    assert table.add_request(Request(0, b"", 9)).index == first.index
    with table.claim_request(Request(0, b"", 9)) as second:
        assert [entry.index for entry in table.list_waiting()] == [first.index, second.index]
    assert [entry.index for entry in table.list_waiting()] == [first.index]
    assert descriptors() == before


@pytest.mark.filterwarnings(FORKS)
def test_the_entry_of_a_dead_client_is_reused(segment: Segment) -> None:
    table = OperatorTable(segment)

    def die() -> None:
        with ExitStack() as claims:
            for _ in range(OPERATOR_ENTRIES):
                claims.enter_context(table.claim_request(Request(0, b"", 9)))
            assert len(table.list_waiting()) == OPERATOR_ENTRIES
            os.kill(os.getpid(), signal.SIGKILL)

    assert exit_status(fork(die)) == -signal.SIGKILL
    assert table.list_waiting() == []
    entries = {table.add_request(Request(0, b"", 9)).index for _ in range(OPERATOR_ENTRIES)}
    assert len(entries) == len(table.list_waiting()) == OPERATOR_ENTRIES


def test_a_full_table_reuses_the_entry_of_the_command_issued_longest_ago(segment: Segment) -> None:
    table = OperatorTable(segment)
    entries = [table.add_request(Request(0, b"", 9)) for _ in range(OPERATOR_ENTRIES)]
    with pytest.raises(OperatorTableError, match=f"full: {OPERATOR_ENTRIES} commands wait"):
        table.add_request(Request(0, b"", 9))
    for serial, entry in enumerate(reversed(entries), 1):
        give(entry, serial)
    assert table.add_request(Request(0, b"", 9)).index == entries[-1].index


@pytest.mark.parametrize(("tick", "was_withdrawn"), [(-1, True), (0, False), (1, False)])
def test_a_request_that_the_clock_is_issuing_is_not_withdrawn(
    segment: Segment, tick: int, was_withdrawn: bool
) -> None:
    table = OperatorTable(segment)
    entry = table.add_request(Request(0, b""))
    assert entry.tick == -1
    entry.given_tick = tick
    assert table.withdraw_request(entry, entry.ticket) is was_withdrawn
