"""Rings read in blocks: no row is lost while there is time, and lost rows are counted exactly."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.mailbox import Writer
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.mailbox.slots import build_signature
from rack.backplane.ring import Ring
from rack.backplane.segment import Segment
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
DEPTH = 16


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox(depth=DEPTH))


def write(writer: Writer, count: int) -> None:
    for _ in range(count):
        serial = writer.serial + 1
        writer.message.id = serial
        writer.message.row[:] = serial
        writer.write(10 * serial)


def serials(ring: Ring) -> tuple[list[int], int]:
    """Return the serials of the rows drained, and how many were lost."""
    rows, lost = ring.read_new_rows()
    assert (rows["message"]["id"] == rows["serial"]).all()
    return rows["serial"].tolist(), lost


def test_each_reader_gets_every_row_once_and_in_order(bus: Segment) -> None:
    writer, ring, second = open_writer(bus, NAME), MailboxRing(bus, NAME), MailboxRing(bus, NAME)
    assert serials(ring) == ([], 0)
    for first in range(1, 100, 11):
        write(writer, 11)
        assert ring.waiting_count == 11
        assert serials(ring) == serials(second) == (list(range(first, first + 11)), 0)
        assert ring.waiting_count == 0
    assert serials(ring) == ([], 0)


def test_a_row_is_a_copy_with_the_head_of_its_message(bus: Segment) -> None:
    writer, ring = open_writer(bus, NAME), MailboxRing(bus, NAME)
    writer.write(7, basis=3)
    row = ring.read_new_rows().rows[0]
    write(writer, 3 * DEPTH)
    assert [row[word] for word in ("serial", "tick", "visible_at", "basis")] == [1, 7, 8, 3]
    assert row["epoch"] == build_signature(1, os.getpid())


@pytest.mark.parametrize("written", [DEPTH - 1, DEPTH, DEPTH + 1, 3 * DEPTH + 5])
def test_lost_rows_are_counted_exactly(bus: Segment, written: int) -> None:
    writer, ring = open_writer(bus, NAME), MailboxRing(bus, NAME)
    write(writer, 3)
    ring.read_new_rows()
    write(writer, written)
    found, lost = serials(ring)
    # One slot is the writer's: it may hold half a message.
    assert found == list(range(3 + written - len(found) + 1, 3 + written + 1))
    assert len(found) == min(written, DEPTH - 1)
    assert lost == written - len(found)


@pytest.mark.slow
def test_every_row_is_whole_or_counted_while_a_writer_hammers(bus: Segment) -> None:
    ring, taken, lost = MailboxRing(bus, NAME), 0, 0

    def hammer() -> None:
        writer = open_writer(bus, NAME)
        while True:
            write(writer, 1)

    with forked(hammer):
        while taken < 8_000:
            wait_until(lambda: ring.waiting_count)
            rows, missing = ring.read_new_rows()
            assert (rows["message"]["row"] == rows["serial"][:, np.newaxis]).all()
            assert (np.diff(rows["serial"]) == 1).all()
            taken, lost = taken + len(rows), lost + missing
    rows, missing = ring.read_new_rows()
    assert taken + len(rows) + lost + missing == MailboxRing(bus, NAME).waiting_count
