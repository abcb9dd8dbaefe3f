"""Mailboxes under time-slice: verdicts, visibility by ticks alone, damage, and the one writer."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.mailbox import Reader, Verdict, Writer
from rack.backplane.mailbox.protocols import open_reader, open_writer
from rack.backplane.mailbox.slots import Slots, build_signature, get_epoch
from rack.backplane.segment import Segment
from rack.backplane.words import Box
from tests.backplane.bus import NAME, mailbox, message_address
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)
NONE, OLD, NEW, BUS_ERROR = Verdict.NONE, Verdict.OLD, Verdict.NEW, Verdict.BUS_ERROR


def ends(segment: Segment) -> tuple[Writer, Reader]:
    return open_writer(segment, NAME), open_reader(segment, NAME)


def write(writer: Writer, tick: int, now: int | None = None) -> bool:
    """Write a message that carries its own serial."""
    writer.message.id = writer.serial + 1
    return writer.write(tick, now)


def seen(reader: Reader, tick: int) -> tuple[int, Verdict]:
    """Return the serial that a read at `tick` gives, and its verdict."""
    reading = reader.read(tick)
    return reading.message.id, reading.verdict


def test_a_message_becomes_visible_at_the_end_of_its_slice(make_bus: MakeBus) -> None:
    writer, reader = ends(make_bus(mailbox(every=4, delay=8)))
    assert seen(reader, 100) == (0, NONE)
    assert not reader.read(100).has_message
    assert write(writer, 4, now=6)
    assert [seen(reader, tick) for tick in (6, 11)] == [(0, NONE), (0, NONE)]
    assert [seen(reader, tick) for tick in (12, 13)] == [(1, NEW), (1, OLD)]
    assert reader.newest == 4


@pytest.mark.parametrize("seed", range(12))
def test_with_phases_and_late_writers_a_reader_gets_what_its_tick_permits(
    make_bus: MakeBus, seed: int
) -> None:
    rng = Random(seed)
    every, within = rng.randint(1, 6), rng.choice((1, 1, 3))
    phase = rng.randrange(every)
    spec = replace(mailbox(every=every, delay=every * within, depth=64), phase=phase)
    writer, reader = ends(make_bus(spec))
    visible, tick = [], phase
    for _ in range(16):
        # Written at `now`: often before its slice ends, sometimes well after.
        late = spec.delay + rng.randrange(3 * every)
        now = tick + rng.choice((0, 1, spec.delay - 1, spec.delay, late))
        in_time = now < tick + spec.delay
        assert write(writer, tick, now) == in_time
        # By counting: the end of its slice or, once that has come, the next tick on the writer's
        # grid.
        on_grid = (t for t in range(now + 1, now + 99) if (t - phase) % every == 0)
        visible.append(tick + spec.delay if in_time else next(on_grid))
        # A late writer takes the newest release.
        tick = max(tick + every * within, now - (now - phase) % every)
    for at in range(visible[-1] + 1):
        assert seen(reader, at)[0] == sum(due <= at for due in visible)


def test_the_host_peeks_at_the_newest_at_once(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox(every=8, delay=8))
    writer, host, board = *ends(segment), open_reader(segment, NAME)
    write(writer, 0)
    assert (host.peek().message.id, host.serial) == (1, 1)
    assert host.peek().verdict is OLD
    assert seen(board, 0) == (0, NONE)


def test_a_damaged_message_is_counted_and_the_last_good_one_kept(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    writer, reader = ends(segment)
    write(writer, 0)
    assert seen(reader, 1) == (1, NEW)
    write(writer, 1)
    segment.bytes[message_address(segment, 2) + 3] ^= 0x10
    assert seen(reader, 2) == (1, OLD)
    assert (reader.statistics.corrupt, reader.statistics.bus_errors) == (1, 0)
    write(writer, 2)
    assert seen(reader, 3) == (3, NEW)


def test_every_bit_of_a_message_is_checked(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    writer, reader = ends(segment)
    write(writer, 0)
    first = message_address(segment, 1)
    for at in range(first, first + writer.spec.size):
        segment.bytes[at] ^= 1
        assert seen(reader, 1) == (0, NONE)
        segment.bytes[at] ^= 1
    assert reader.statistics.corrupt == writer.spec.size
    assert seen(reader, 1) == (1, NEW)


def test_a_message_overwritten_before_it_is_read_is_a_bus_error(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox(depth=8))
    writer, reader = ends(segment)
    write(writer, 0)
    assert seen(reader, 1) == (1, NEW)
    for tick in range(1, 30):
        write(writer, tick)
    # Tick 10 saw message 10, and the slots reach back to 23 only: a later message would not be
    # visible yet.
    assert seen(reader, 10) == (1, BUS_ERROR)
    assert (reader.statistics.bus_errors, reader.statistics.corrupt) == (1, 0)
    assert seen(reader, 28) == (28, NEW)


@pytest.mark.parametrize("depth", [4, 32])
def test_earlier_messages_are_returned_while_they_are_in_their_slots(
    make_bus: MakeBus, depth: int
) -> None:
    writer, reader = ends(make_bus(mailbox(depth=depth)))
    for tick in range(100):
        write(writer, tick)
    oldest = 100 - depth + 1
    assert seen(reader, oldest - 1) == (0, NONE)
    assert not reader.read(oldest - 1).has_message
    assert reader.statistics.bus_errors == 2
    assert seen(reader, oldest) == (oldest, NEW)


def test_a_second_writer_is_refused_with_the_first_ones_process(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    writer = open_writer(segment, NAME)

    def second() -> bool:
        first = rf"'{NAME}' already has a writer \(process {segment.launcher}\)"
        with pytest.raises(MailboxError, match=first):
            open_writer(segment, NAME)
        return True

    assert second()
    assert exit_status(fork(second)) == 0
    writer.close()
    # A claim ends with its process.
    assert exit_status(fork(lambda: write(open_writer(segment, NAME), 0))) == 0
    open_writer(segment, NAME)


def test_a_forged_message_is_counted_with_the_process_that_it_names(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox())
    writer, reader = ends(segment)
    write(writer, 0)
    assert seen(reader, 1) == (1, NEW)
    forger = Slots(segment, writer.spec)
    signature = build_signature(get_epoch(writer.slots.signature), 4321)
    forger.resume_writing(signature, forger.box[Box.HEAD])
    forger.publish_message(1, 2, 1)
    assert seen(reader, 2) == (1, OLD)
    statistics = reader.statistics
    assert (statistics.forged, statistics.forger) == (1, 4321)
    assert (statistics.bad_reads, statistics.corrupt, statistics.bus_errors) == (1, 0, 0)


@pytest.mark.parametrize(("bad", "expected"), [(1, (7, NEW)), (4, (4, NEW)), (5, (1, OLD))])
def test_a_read_steps_back_over_a_bounded_number_of_bad_messages(
    make_bus: MakeBus, bad: int, expected: tuple[int, Verdict]
) -> None:
    segment = make_bus(mailbox(depth=16))
    writer, reader = ends(segment)
    write(writer, 0)
    assert seen(reader, 1) == (1, NEW)
    for tick in range(1, 8):
        write(writer, tick)
    # The newest are bad; after so many tries the last good one stays.
    for serial in range(8, 8 - bad, -1):
        segment.bytes[message_address(segment, serial)] ^= 1
    assert seen(reader, 8) == expected
    assert (reader.statistics.corrupt, reader.statistics.bad_reads) == (bad, 1)
