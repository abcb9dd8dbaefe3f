"""Mailboxes under protocol queue: first in first out, with one reader.

Each message is read once and in order. The writer sends any number of messages in a cycle. They are
published together at its end, by one store, and become visible as under time-slice. A writer killed
before that has sent none of them. The reader takes the messages that are visible at its release
tick, oldest first, as many as it has room for.

A queue is bounded: its `capacity` is the largest number of unread messages. When it is full, `send`
returns False. The writer never waits, and no unread message is overwritten. The number of messages
taken is a message too: in each of its cycles the reader writes its position into a separate
mailbox, `<queue>_taken`, under time-slice. So fullness depends on ticks alone: a message that the
reader takes at tick T gives the writer room from T plus the reader's cycle on.

The reader's position is in shared memory before its level processes, so a message is read at most
once, whatever happens: a reader killed in a cycle has taken the messages of that cycle, and its
successor continues after them. The opposite order would read them twice, and a message that makes
its reader fail would make every successor fail too. A level that must know whether a message was
acted on compares its id with the id that the reader's status echoes. A successor reads the position
from a word in the queue's head, where it is multiplied by 3. This is an AN code: no multiple of 3
is one bit away from another. The mailbox alone would not suffice: if its newest message is damaged,
the previous one contains an older position. If the word is damaged, the mailbox is intact.

A lost, damaged or forged message is counted, and the order continues with the next one.

Alternative considered: a position word in the mailbox's head, without a mailbox. It is not a
function of ticks, so whether a queue is full would depend on which process is faster.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from struct import Struct

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.mailbox import Reader, Reading, Writer
from rack.backplane.mailbox.slots import get_pid
from rack.backplane.message import AnyMessage, Message, copy_message, field
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Slot


class QueueTaken(Message, version=1):
    """Position of the reader of a queue, written by that reader."""

    taken: int = field(
        unit="1",
        doc="serial of the newest message that the reader of the queue has taken (0: none)",
    )
    unread: int = field(unit="1", doc="messages that this reader could see, and left in the queue")


# Plain integers for the hot path.
_PUT_POSITION = Struct("@2q").pack_into
UNLIMITED = 1 << 62
"""Room for every message."""


def get_position_mailbox(queue: str) -> str:
    """Return the name of the mailbox in which a queue's reader writes its position."""
    return f"{queue}_taken"


def is_position_mailbox(spec: MailboxSpec) -> bool:
    """Check whether a mailbox contains the position of a queue's reader.

    The board writes such a mailbox, not the level.
    """
    return spec.message == QueueTaken.message_type.name


def list_queues(layout: Layout) -> list[MailboxSpec]:
    """Return the queues between tasks.

    The rings of host boards are not by ticks, so they have no position and are not included.
    """
    names = {box.name for box in layout.mailboxes}
    return [
        box
        for box in layout.mailboxes
        if box.protocol == "queue" and get_position_mailbox(box.name) in names
    ]


class QueueWriter(Writer):
    """Writer of a queue. A level fills `message` and calls `send`.

    The board calls `write` once a cycle.

    Attributes:
        taken: Position of the reader as of the writer's release tick, updated by the board.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        slots = self.slots
        # Messages are published to a copy of the mailbox's head and then shown together.
        self._shared = slots.box
        slots.box = memoryview(bytearray(slots.box)).cast("q")
        # A predecessor may have been killed just before it stored this word.
        self._shared[Box.SENT] = self.serial
        self.taken = 0
        self._pending: list[bytes] = []
        self._shown_at = 0

    def count_free_places(self) -> int:
        """Return the number of messages that can still be sent in this cycle."""
        unread = self.serial - self.taken + self.held + len(self._pending)
        return max(0, self.spec.capacity - unread)

    def send(self, basis: int | None = None) -> bool:
        """Put a copy of the message into the queue. Returns False if the queue is full."""
        if not self.count_free_places():
            self.refused += 1
            self._shared[Box.REFUSED] += 1
            return False
        self._pending.append(bytes(self.message.raw))
        return True

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish the messages sent in the cycle released at `tick`.

        Args:
            tick: Release tick of the cycle that writes.
            now: Current tick. None if the end of the cycle has not come.
            basis: Tick of the oldest information on which the messages depend, by default
                `tick`.

        Returns:
            False if the messages are too late.
        """
        if not self._pending:
            return True
        if basis is None:
            basis = tick
        visible_at = self.compute_visible_tick(tick, now)
        for _ in self.iterate_outgoing():
            self.slots.publish_message(tick, visible_at, basis)
        self.show_published()
        return self.is_in_time(tick, now)

    def compute_visible_tick(self, tick: int, now: int | None) -> int:
        """Return the tick from which messages, including lost ones, are visible."""
        self._shown_at = super().compute_visible_tick(tick, now)
        return self._shown_at

    def iterate_outgoing(self) -> Iterator[None]:
        """Put each message of the cycle into `message` in turn, then restore its content."""
        slots = self.slots
        present = bytes(self.message.raw)
        if self._shared[Box.HEAD] != slots.box[Box.HEAD]:
            self.intruder = get_pid(slots.heads[(self.serial + 1) & slots.mask][Slot.EPOCH])
        pending = self._pending
        self._pending = []
        for content in pending:
            self.message.raw[:] = content
            yield
        self.message.raw[:] = present

    def publish_message(
        self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()
    ) -> bool:
        """Publish `message`, without showing it to readers before `show_published` is called.

        Args:
            tick: Release tick of the cycle that writes.
            visible_at: Tick from which the message is visible.
            basis: Tick of the oldest information on which the message depends.
            damage: Bits to flip, see `Slots.publish_message`.
        """
        self.slots.publish_message(tick, visible_at, basis, damage)
        return True

    def lose_message(self) -> None:
        """Publish a serial without its message, to inject a loss.

        The reader finds the gap at the tick at which the message would be visible.
        """
        slots = self.slots
        slots.heads[(self.serial + 1) & slots.mask][Slot.VISIBLE_AT] = self._shown_at
        slots.publish_gap()

    def show_published(self) -> None:
        """Make all published messages visible, by one store each to observers and the reader."""
        self._shared[Box.HEAD] = serial = self.serial
        self._shared[Box.SENT] = serial


class QueueReader(Reader):
    """The only reader of a queue. A second one is refused with `MailboxError`.

    A new reader continues after the position of its predecessor.

    Attributes:
        taken: Position of the reader, the serial of the newest message taken.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        self._position = Writer(segment, get_position_mailbox(name))
        written = Reader(segment, get_position_mailbox(name)).peek().message.taken
        taken, rest = divmod(self.slots.box[Box.POSITION], 3)
        self.taken = written if rest else max(written, taken)
        self._farthest = self.spec.delay + self.spec.every
        # Until a new message comes, readings contain the last message taken.
        if self.taken and self._fetch_good(self.taken):
            self.transfers = 0

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Take every message visible at `tick`."""
        return self.take_messages(tick, UNLIMITED)

    def take_messages(self, tick: int, most: int, now: int | None = None) -> Reading[AnyMessage]:
        """Take the messages visible at `tick`, oldest first, and publish the position.

        Args:
            tick: Release tick of the reading cycle.
            most: Maximum number of messages to take.
            now: Current tick, as in `Writer.write`.

        Returns:
            The newest message taken, with the others in `earlier`.
        """
        self.accesses += 1
        slots = self.slots
        box = slots.box
        count = 0
        earlier = list[AnyMessage]()
        head = box[Box.HEAD]
        last = min(box[Box.SENT], self.taken + slots.depth)
        slots.fence()
        if head > last and slots.fetch_message(head) and not slots.is_lawful(self._signature):
            # Count a forged message without taking it, since the writer's next message will replace
            # it.
            self.statistics.bad_reads += 1
            self._count_forged()
        while count < most and self._can_take(self.taken + 1, last, tick):
            before = copy_message(self.message) if count else None
            if not self._fetch_good(self.taken + 1):
                # Count the fault of the message fetched last, which is not good.
                statistics = self.statistics
                statistics.bad_reads += 1
                if slots.serial != self.taken + 1:
                    statistics.lost += 1
                elif not slots.passes_check:
                    statistics.corrupt += 1
                else:
                    self._count_forged()
            else:
                if before is not None:
                    earlier.append(before)
                count += 1
            self.taken += 1
        newest = self.taken
        while self._can_take(newest + 1, last, tick):
            newest += 1
        box[Box.POSITION] = 3 * self.taken
        position = self._position
        _PUT_POSITION(position.message.raw, 0, self.taken, newest - self.taken)
        position.write(tick, now)
        if not count:
            return self._unchanged
        return self._new._replace(earlier=tuple(earlier)) if earlier else self._new

    def _can_take(self, serial: int, last: int, tick: int) -> bool:
        """Check whether a serial can be taken or skipped now.

        A message that is visible too far ahead cannot be good, so it is not waited for.
        """
        if serial > last:
            return False
        ticks_ahead = self.slots.read_visible_tick(serial) - tick
        return ticks_ahead <= 0 or (
            ticks_ahead > self._farthest and not self.slots.fetch_message(serial)
        )

    def close(self) -> None:
        """Release the claim of the reader's position."""
        self._position.close()
