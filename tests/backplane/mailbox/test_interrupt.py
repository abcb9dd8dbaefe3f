"""Protocol interrupt on a bus: the messages that a board's reader sees, and when."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.backplane.layout import InterruptSpec, MailboxSpec, TaskSpec
from rack.backplane.mailbox.interrupt import (
    BoardInbox,
    InterruptReader,
    InterruptWriter,
    open_inbox,
)
from rack.backplane.mailbox.mailbox import Reader, Verdict
from rack.backplane.mailbox.protocols import open_reader
from rack.backplane.segment import Segment
from tests.backplane.bus import CLOCK_NS, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS

pytestmark = pytest.mark.filterwarnings(FORKS)
SENDERS = ("first", "second", "third")
SLOT = 9
"""The reading board's."""


def box(
    sender: str, every: int = 1, service_ns: int = 60_000, sent_ns: int = 500_000, depth: int = 16
) -> MailboxSpec:
    """Return the mailbox of one sender, read by the task `reader`."""
    due, delay = -(-sent_ns // CLOCK_NS), -(-(sent_ns + service_ns) // CLOCK_NS)
    interrupt = InterruptSpec(sent_ns, service_ns, depth, due, every, (SLOT,))
    plain = mailbox("interrupt", every, delay, depth=64, name=f"{sender}.point", writer=sender)
    return replace(plain, interrupt=interrupt)


def tasks() -> tuple[TaskSpec, ...]:
    """Return the senders' tasks, in slots opposite to the order of their mailboxes, and the
    reader's."""
    return (
        *(task(name, slot=5 - at) for at, name in enumerate(SENDERS)),
        task("reader", slot=SLOT),
    )


class Board:
    """The reading board, and the writers of its mailboxes. A message's id is the tick of its
    release."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.writers = {name: InterruptWriter(segment, f"{name}.point") for name in SENDERS}
        self.restart()

    def restart(self) -> None:
        """Open the reader again, as a restarted task does."""
        inbox = open_inbox(self.segment, "reader")
        assert inbox is not None
        self.inbox: BoardInbox = inbox
        self.readers = {
            name: open_reader(self.segment, f"{name}.point", inbox=inbox) for name in SENDERS
        }

    def send(self, tick: int, *senders: str, now: int | None = None) -> bool:
        """Write a message of each of these senders, of all by default; say whether all were in
        time."""
        in_time = []
        for writer in (self.writers[name] for name in senders or SENDERS):
            writer.message.id, writer.message.row = tick, tick
            in_time.append(writer.write(tick, now))
        return all(in_time)

    def read(self, tick: int) -> dict[str, int]:
        """Read every mailbox; return the ids of the new messages by sender."""
        found = {name: reader.read(tick) for name, reader in self.readers.items()}
        return {name: int(reading.message.id) for name, reading in found.items() if reading.is_new}


def boxes(**how: int) -> list[MailboxSpec]:
    return [box(name, **how) for name in SENDERS]


def test_a_message_shows_at_the_first_release_after_its_service(make_bus: MakeBus) -> None:
    board = Board(make_bus(*boxes(), *tasks()))
    board.send(0)
    assert board.read(0) == {}
    assert board.read(1) == dict.fromkeys(SENDERS, 0)
    assert board.readers["first"].read(1).verdict is Verdict.OLD
    # One that was away finds the newest served.
    for tick in range(1, 30):
        board.send(tick)
    assert board.read(25) == dict.fromkeys(SENDERS, 24)
    assert board.inbox.count == 75


def test_a_message_written_in_the_tick_in_which_it_is_due_is_late(make_bus: MakeBus) -> None:
    # Sent 0.5 ms after the second tick that follows the release, and visible from the third on.
    segment = make_bus(*boxes(every=4, sent_ns=2 * CLOCK_NS + 500_000), *tasks())
    writer = InterruptWriter(segment, "first.point")
    for now, visible in ((None, 11), (8, 11), (10, 11), (11, 12), (12, 13)):
        assert writer.is_in_time(8, now) is (visible == 11)
        assert writer.compute_visible_tick(8, now) == visible


def test_a_message_served_across_a_release_is_visible_at_the_next(make_bus: MakeBus) -> None:
    # Each takes 0.9 ms: from 0.5 ms on the handler is done at 1.4, 2.3 and 3.2 ms, with a release
    # at 2.5.
    board = Board(make_bus(*boxes(service_ns=900_000), *tasks()))
    board.send(0)
    # The sender in the lowest slot comes first.
    assert board.read(1) == {"third": 0, "second": 0}
    assert board.read(2) == {"first": 0}
    assert (board.inbox.count, board.inbox.accepted_ns) == (3, 2_700_000)


def test_a_full_inbox_loses_the_last_messages_at_this_board_only(make_bus: MakeBus) -> None:
    board = Board(make_bus(*boxes(depth=1), *tasks()))
    for tick in range(5):
        board.send(tick)
        assert board.read(tick + 1) == {"third": tick, "second": tick}
    lost = {name.partition(".")[0]: line.lost for name, line in board.inbox.lines.items()}
    assert lost == {"first": 5, "second": 0, "third": 0}
    # An observer of the host side reads by ticks, without the inbox.
    assert Reader(board.segment, "first.point").read(5).message.id == 4


@pytest.mark.parametrize("idle", [0, 3, 40])
def test_a_restarted_reader_continues_as_the_one_before_it(make_bus: MakeBus, idle: int) -> None:
    # Two thirds of the time the handler works; a burst of three is not done before the next tick.
    board = Board(make_bus(*boxes(every=2, service_ns=1_500_000, depth=2), *tasks()))
    stays = open_inbox(board.segment, "reader")
    assert stays is not None
    readers = [InterruptReader(board.segment, name, stays) for name in stays.lines]
    for tick in range(0, 40, 2):
        board.send(tick)
        for reader in readers:
            reader.read(tick)
    board.restart()
    for tick in range(40 + idle, 60 + idle):
        if tick % 2 == 0:
            board.send(tick)
        found = board.read(tick)
        kept = {r.spec.writer: r.read(tick) for r in readers}
        if tick > 40 + idle:
            assert found == {
                name: reading.message.id for name, reading in kept.items() if reading.is_new
            }
        assert {name: r.serial for name, r in board.readers.items()} == {
            r.spec.writer: r.serial for r in readers
        }


def test_a_lost_message_raises_no_interrupt_and_a_damaged_one_does(make_bus: MakeBus) -> None:
    board = Board(make_bus(*boxes(), *tasks()))
    board.send(0, "first")
    writer = board.writers["first"]
    writer.lose_message()
    assert board.read(1) == {"first": 0}
    assert (board.readers["first"].found, board.inbox.count) == (2, 1)
    writer.publish_message(2, 3, 2, damage=(5,))
    assert board.read(3) == {}
    assert board.inbox.count == 2
    assert board.readers["first"].statistics.corrupt == 1
    assert board.readers["first"].found == 3
    board.send(3, "first")
    assert board.read(4) == {"first": 3}


def test_between_tasks_of_one_slot_nothing_is_interrupted(make_bus: MakeBus) -> None:
    how = replace(box("first"), interrupt=InterruptSpec(500_000, 60_000, 16, 1, 1))
    segment = make_bus(how, task("first", slot=4), task("reader", slot=4))
    assert open_inbox(segment, "reader") is None
    writer, reader = InterruptWriter(segment, "first.point"), open_reader(segment, "first.point")
    writer.write(0)
    assert [reader.read(tick).verdict for tick in (0, 1)] == [Verdict.NONE, Verdict.NEW]
