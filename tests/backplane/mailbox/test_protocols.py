"""The protocols compared: when a message becomes visible, and the state a dead writer leaves."""

from __future__ import annotations

import random
import time

import numpy as np
import pytest
from xxhash import xxh3_64_intdigest

from rack.backplane.layout import PROTOCOLS, TICK_PROTOCOLS, Protocol
from rack.backplane.mailbox.mailbox import Reader, Verdict, Writer
from rack.backplane.mailbox.protocols import open_observer, open_reader, open_writer
from rack.backplane.mailbox.slots import CHECKED_FROM, Slots, get_epoch
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_lock_semaphore
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus
from tests.processes import BOUND_S, FORKS, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
READS = 10_000
KILLS = 8
AT_ONCE: tuple[Protocol, ...] = ("double-buffer", "lock")


def write_next(writer: Writer) -> None:
    # A write that the lock cut off has no serial.
    writer.message.id = writer.message.row[:] = writer.serial + 1
    writer.write(writer.serial + 1)


def hammer(segment: Segment) -> None:
    """Write for ever; every element of a message holds its serial."""
    writer = open_writer(segment, NAME)
    while True:
        write_next(writer)


def is_whole(reader: Reader) -> bool:
    """Check whether the last good message holds its own serial everywhere."""
    row = reader.message.row
    return reader.message.id == row[0] == reader.serial and bool((row == row[0]).all())


@pytest.mark.parametrize("protocol", AT_ONCE)
def test_a_message_shows_at_once(make_bus: MakeBus, protocol: Protocol) -> None:
    segment = make_bus(mailbox(protocol, every=8, delay=8))
    writer, reader = open_writer(segment, NAME), open_reader(segment, NAME)
    assert reader.read(0).verdict is Verdict.NONE
    assert writer.write(0, now=2)
    assert [reader.read(0).verdict for _ in range(2)] == [Verdict.NEW, Verdict.OLD]
    # And is late where it would be under the others.
    assert [writer.write(0, now) for now in (None, 7, 8, 19)] == [True, True, False, False]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_an_observer_reads_by_its_protocol_and_never_waits(
    make_bus: MakeBus, protocol: Protocol
) -> None:
    segment = make_bus(mailbox(protocol, every=4, delay=4))
    writer, observer = open_writer(segment, NAME), open_observer(segment, NAME)
    writer.write(0)
    if protocol == "lock":
        get_lock_semaphore(segment, NAME).acquire(0)
    expected = Verdict.NONE if protocol in TICK_PROTOCOLS else Verdict.NEW
    assert observer.read(0).verdict is expected
    assert observer.read(4).has_message
    assert observer.statistics.bus_errors == 0


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_reader_never_gets_half_a_message(make_bus: MakeBus, protocol: Protocol) -> None:
    segment = make_bus(mailbox(protocol, depth=4))
    reader, latest, fresh = open_reader(segment, NAME), np.iinfo(np.int64).max, 0
    with forked(lambda: hammer(segment)):
        deadline = time.monotonic() + BOUND_S
        while reader.accesses < READS or fresh < READS // 100:
            fresh += reader.read(latest).is_new
            assert is_whole(reader)
            assert time.monotonic() < deadline
    assert reader.statistics.corrupt == 0


def follows(slots: Slots, serial: int) -> bool:
    """Check whether a message's checksum is seeded with that of the message before it."""
    assert slots.fetch_message(serial - 1)
    before = slots.chain
    assert slots.fetch_message(serial)
    return xxh3_64_intdigest(slots.record[CHECKED_FROM:], before) == slots.chain


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_writer_killed_anywhere_leaves_its_last_whole_message(
    make_bus: MakeBus, protocol: Protocol
) -> None:
    segment = make_bus(mailbox(protocol, depth=4))
    reader, slots = open_reader(segment, NAME), Slots(segment, segment.layout.find_mailbox(NAME))
    rng, latest = random.Random(7), np.iinfo(np.int64).max
    for _ in range(KILLS):
        known = reader.serial
        with forked(lambda: hammer(segment)):
            wait_until(lambda: reader.peek().has_message and reader.serial > known)  # noqa: B023  called before the next turn
            time.sleep(rng.uniform(0.0, 0.002))
        assert reader.read(latest).has_message
        assert reader.serial == slots.box[0]
        assert is_whole(reader)
        successor = open_writer(segment, NAME)
        assert successor.serial == reader.serial
        write_next(successor)
        successor.close()
        assert follows(slots, reader.serial + 1)
        assert reader.read(latest).is_new
    # A fast writer may overtake a reader: a bus error. It never shows a damaged message.
    assert reader.statistics.corrupt == 0
    assert slots.fetch_message(reader.serial)
    assert get_epoch(slots.signature) == 2 * KILLS
