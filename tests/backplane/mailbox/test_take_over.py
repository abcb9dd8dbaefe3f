"""A standby takes over a mailbox whose writer is dead, stopped or late: one writer at any time, and
no reader gets a message of the one before."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.mailbox import Reader, Verdict, Writer
from rack.backplane.mailbox.protocols import open_reader, open_standby_writer, open_writer
from rack.backplane.words import Box
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus
from tests.backplane.mailbox.mines import Bomb, mine
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)
NEW, OLD = Verdict.NEW, Verdict.OLD


def write(writer: Writer, tick: int, what: int) -> None:
    writer.message.row[:] = what
    writer.write(tick)


def read(reader: Reader, tick: int) -> tuple[int, Verdict]:
    reading = reader.read(tick)
    row = reading.message.row
    assert (row == row[0]).all(), "half a message"
    return int(row[0]), reading.verdict


@pytest.mark.parametrize("has_died", [True, False])
def test_a_standby_continues_after_the_newest_message(make_bus: MakeBus, has_died: bool) -> None:
    segment = make_bus(mailbox(depth=4))
    writer, standby = open_writer(segment, NAME), open_standby_writer(segment, NAME)
    reader = open_reader(segment, NAME)
    write(writer, 0, 1)
    assert read(reader, 1) == (1, NEW)
    if has_died:
        writer.close()
    standby.take_over()
    assert standby.claim.is_locked == has_died
    assert (standby.claim.is_valid, writer.claim.is_valid) == (True, False)
    write(standby, 1, 2)
    assert read(reader, 2) == (2, NEW)
    if not has_died:
        writer.claim.release()
        assert standby.claim.try_lock()


def test_two_runs_with_and_without_a_hand_over_have_equal_chains(make_bus: MakeBus) -> None:
    segment = make_bus(mailbox(depth=4))
    writer = open_writer(segment, NAME)
    chains = []
    for is_handed_over in (False, True):
        writer.slots.serial = writer.slots.chain = segment.get_box(NAME)[Box.HEAD] = 0
        write(writer, 0, 1)
        if is_handed_over:
            writer = open_standby_writer(segment, NAME)
            writer.take_over()
        write(writer, 1, 2)
        chains.append(writer.slots.chain)
    assert chains[0] == chains[1]


@pytest.mark.parametrize("serials", [0, 1, 3, 6])
@pytest.mark.parametrize("knows", [True, False], ids=["known writer", "unknown writer"])
def test_what_a_stopped_writer_still_stores_is_never_accepted(
    make_bus: MakeBus, serials: int, knows: bool
) -> None:
    segment = make_bus(mailbox(depth=4))
    writer, standby = open_writer(segment, NAME), open_standby_writer(segment, NAME)
    reader, ring = open_reader(segment, NAME), MailboxRing(segment, NAME)
    write(writer, 0, 1)
    if knows:
        assert read(reader, 1) == (1, NEW)
    standby.take_over()
    for serial in range(serials):
        write(standby, 1 + serial, 10 + serial)
    # It was stopped just before it published its second message.
    write(writer, 1, 99)
    last = serials
    found, _ = read(reader, last + 2)
    assert found != 99
    rows = ring.read_new_rows().rows
    assert 99 not in {int(row["message"]["row"][0]) for row in rows}
    # The next message of the standby repairs the head, and is read.
    write(standby, last + 2, 50)
    assert read(reader, last + 3) == (50, NEW)
    assert reader.statistics.corrupt == 0


@pytest.mark.parametrize("first_continues", [2, 3], ids=["before third", "after third"])
def test_what_two_stopped_writers_still_store_is_never_accepted(
    make_bus: MakeBus, first_continues: int
) -> None:
    """The first one sets the head, so that the message of the second looks as if published."""
    segment = make_bus(mailbox(depth=4))
    writers = [open_writer(segment, NAME), *(open_standby_writer(segment, NAME) for _ in range(3))]
    reader, ring = open_reader(segment, NAME), MailboxRing(segment, NAME)
    write(writers[0], 0, 1)
    assert read(reader, 1) == (1, NEW)
    for number in (1, 2, 3):
        if number == first_continues:
            write(writers[0], 1, 98)
        writers[number].take_over()
        if number == 2:
            write(writers[1], 1, 99)
        assert read(reader, 2) == (1, OLD)
        assert not {98, 99} & {int(row["message"]["row"][0]) for row in ring.read_new_rows().rows}
    write(writers[3], 2, 50)
    assert read(reader, 3) == (50, NEW)


@pytest.mark.parametrize("is_written_again", [False, True])
def test_a_head_that_a_stopped_writer_has_set_back_loses_no_message(
    make_bus: MakeBus, is_written_again: bool
) -> None:
    segment = make_bus(mailbox(depth=4))
    first, second, third = (
        open_writer(segment, NAME),
        open_standby_writer(segment, NAME),
        open_standby_writer(segment, NAME),
    )
    reader = open_reader(segment, NAME)
    write(first, 0, 1)
    second.take_over()
    for tick in range(1, 7):
        write(second, tick, 1 + tick)
    write(first, 1, 99)
    if is_written_again:
        write(second, 7, 8)
    third.take_over()
    write(third, 8, 9)
    assert read(reader, 9) == (9, NEW)
    assert reader.serial == 8 + is_written_again


def test_a_standby_that_dies_in_its_claim_takes_no_message_from_the_active_copy(
    make_bus: MakeBus,
) -> None:
    names = [f"writer.point{number}" for number in range(6)]
    segment = make_bus(*(mailbox(depth=4, name=name) for name in names))
    for number, name in enumerate(names):
        first = open_writer(segment, name)
        second, third = (open_standby_writer(segment, name) for _ in range(2))
        reader = open_reader(segment, name)
        write(first, 0, 1)
        assert read(reader, 1) == (1, NEW)

        def take_over(second: Writer = second, number: int = number) -> None:
            mine(second, Bomb(number))
            second.take_over()

        assert (exit_status(fork(take_over)) != 0) == (number < 5)
        # The fifth store follows the claim: then the active copy may not write any more.
        if number < 4:
            write(first, 1, 2)
            third.take_over()
            assert read(reader, 3) == (2, NEW), number
        for writer in (first, second, third):
            writer.close()


MOST_STORES = 100


@pytest.mark.parametrize(
    "is_stopped", [False, pytest.param(True, marks=pytest.mark.thorough)], ids=["dead", "stopped"]
)
def test_a_kill_at_any_store_between_claim_and_publication_leaves_a_whole_mailbox(
    make_bus: MakeBus, is_stopped: bool
) -> None:
    """The third copy continues, whatever the second has done; the first may store once more."""
    names = [f"writer.point{number}" for number in range(MOST_STORES)]
    segment = make_bus(*(mailbox(depth=4, name=name) for name in names))
    survived = False
    for number, name in enumerate(names):
        first = open_writer(segment, name)
        reader = open_reader(segment, name)
        write(first, 0, 1)
        assert read(reader, 1) == (1, NEW)
        if not is_stopped:
            first.close()
        second = open_standby_writer(segment, name)

        def take_over(second: Writer = second, number: int = number) -> None:
            mine(second, Bomb(number))
            second.take_over()
            write(second, 1, 2)

        survived = exit_status(fork(take_over)) == 0
        second.close()
        assert read(reader, 2) in ((1, OLD), (2, NEW))
        third = open_standby_writer(segment, name)
        third.take_over()
        if is_stopped:
            write(first, 1, 99)
        write(third, 2, 3)
        assert read(reader, 3) == (3, NEW), number
        assert reader.statistics.corrupt == 0
        assert third.slots.signature == segment.get_box(name)[Box.CLAIMANT], "one writer"
        third.close()
        first.close()
        if survived:
            break
    assert survived
    assert number > 20
