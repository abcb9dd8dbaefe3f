"""Mailboxes under protocol queue: first in first out, with one reader.

Each message is read once and in order. The writer sends any number of messages in a cycle. They are
published together at the end of the cycle, by one store, and become visible as under time-slice. If
the writer is killed before that store, none of them is sent. The reader takes the messages that are
visible at its release tick, oldest first, as many as its level has room for.

A queue is bounded: its `capacity` is the maximum number of unread messages. If it is full, `send`
returns False. The writer never waits, and no unread message is overwritten. The position of the
reader is the serial of the newest message that it has taken. In each of its cycles the reader
writes its position into a separate mailbox, `<queue>_taken`, under time-slice. Whether the queue is
full therefore depends on ticks alone: a place that becomes free at tick T can be used by the writer
from T plus the reader's cycle on.

The reader stores its position in shared memory before its level processes the messages, so a
message is read at most once: if a reader is killed in a cycle, its successor continues after the
messages of that cycle. With the opposite order the successor would read them a second time, and a
message that makes its reader fail would make every successor fail too. A level that must know
whether a message was acted on compares its id with the id that the reader's status echoes. The
successor reads the position from a word in the queue's head, where it is stored multiplied by 3, as
an AN code: no multiple of 3 differs from another in a single bit. The mailbox alone would not
suffice, because if its newest message is damaged, the previous one contains an older position. If
the word is damaged instead, the mailbox has the correct position.

A lost, damaged or forged message is counted, and the reader continues with the next one.

Alternative considered: a position word in the mailbox's head, without a second mailbox. Its value
does not depend on ticks alone, so whether a queue is full would depend on which process is faster.
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
"""Number of messages to take if there is no limit."""


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

    The rings of host boards are not included: their readers have no mailbox in which to report
    their positions.
    """
    names = {box.name for box in layout.mailboxes}
    return [
        box
        for box in layout.mailboxes
        if box.protocol == "queue" and get_position_mailbox(box.name) in names
    ]


class QueueWriter(Writer):
    """Writer of a queue.

    A level fills `message` and calls `send`, any number of times in a cycle. The board calls
    `write` once per cycle to publish these messages.

    Attributes:
        position: Reader of the mailbox with the position of the queue's reader. The board reads it
            at every release.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        super().__init__(segment, name)
        slots = self.slots
        # The messages of a cycle are published one by one in a private copy of the mailbox's head.
        # `show_published` then updates the real head.
        self._shared = slots.box
        slots.box = memoryview(bytearray(slots.box)).cast("q")
        # A predecessor may have been killed just before it stored this word.
        self._shared[Box.SENT] = self.serial
        self.position = Reader(segment, get_position_mailbox(name))
        self._pending: list[bytes] = []
        self._shown_at = 0

    def count_free_places(self) -> int:
        """Return the number of messages that can still be sent in this cycle."""
        unread: int = self.serial - self.position.message.taken + self.held + len(self._pending)
        return max(0, self.spec.capacity - unread)

    def send(self, basis: int | None = None) -> bool:
        """Store a copy of `message`, to be published at the end of this cycle.

        `basis` is ignored, because `write` gets the basis of all messages of a cycle.

        Returns:
            False if the queue is full. The message is counted as refused.
        """
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
            now: Current tick. None if the cycle is known to be on time.
            basis: Tick of the oldest information on which the messages depend, by default
                `tick`.

        Returns:
            False if messages were published after the end of their cycle.
        """
        if not self._pending:
            return True
        visible_at = self.compute_visible_tick(tick, now)
        for _ in self.iterate_outgoing():
            self.slots.publish_message(tick, visible_at, tick if basis is None else basis)
        self.show_published()
        return self.is_in_time(tick, now)

    def compute_visible_tick(self, tick: int, now: int | None) -> int:
        """Return the tick from which the messages of a cycle are visible.

        The tick is also stored for `lose_message`.

        Args:
            tick: Release tick of the cycle that writes.
            now: Current tick. None if the cycle is known to be on time.
        """
        self._shown_at = super().compute_visible_tick(tick, now)
        return self._shown_at

    def iterate_outgoing(self) -> Iterator[None]:
        """Yield once for each message sent in this cycle, after copying it into `message`.

        The caller publishes it. At the end, the original content of `message` is restored.
        """
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
        """Write `message` to its slot. Readers find it only after `show_published` is called.

        See `Writer.publish_message` for the arguments. This access cannot time out.
        """
        self.slots.publish_message(tick, visible_at, basis, damage)
        return True

    def lose_message(self) -> None:
        """Publish the next serial without filling its slot, to inject the loss of a message.

        The reader finds the gap at the tick at which the message would have become visible.
        """
        slots = self.slots
        slots.heads[(self.serial + 1) & slots.mask][Slot.VISIBLE_AT] = self._shown_at
        slots.publish_gap()

    def show_published(self) -> None:
        """Make the messages in the slots visible, first to observers and then to the reader."""
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
        # Until a message is taken, readings contain the last message that the predecessor took.
        if self.taken and self._fetch_good(self.taken):
            self.transfers = 0

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Take all messages visible at `tick`, and return the reading as `take_messages` does."""
        return self.take_messages(tick, UNLIMITED)

    def take_messages(self, tick: int, most: int, now: int | None = None) -> Reading[AnyMessage]:
        """Take the messages visible at `tick`, oldest first, and publish the position.

        Args:
            tick: Release tick of the reading cycle.
            most: Maximum number of good messages to take.
            now: Current tick, as in `Writer.write`.

        Returns:
            The newest message taken, with the others taken by this call in `earlier`. If none was
                taken, the last message again with verdict OLD or NONE.
        """
        self.accesses += 1
        slots = self.slots
        box = slots.box
        count = 0
        earlier = list[AnyMessage]()
        head = box[Box.HEAD]
        last = min(box[Box.SENT], self.taken + slots.depth)
        slots.fence()
        if (
            head > last
            and slots.fetch_message(head)
            and not slots.is_from_claimant(self._signature)
        ):
            # The newest message is forged. Count it without taking it, because the writer's next
            # message will overwrite it.
            self.statistics.bad_reads += 1
            self._count_forged()
        while count < most and self._can_take(self.taken + 1, last, tick):
            before = copy_message(self.message) if count else None
            if not self._fetch_good(self.taken + 1):
                # The message is lost, damaged or forged. Count it and continue with the next.
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
        _PUT_POSITION(self._position.message.raw, 0, self.taken, newest - self.taken)
        self._position.write(tick, now)
        if not count:
            return self._unchanged
        return self._new._replace(earlier=tuple(earlier)) if earlier else self._new

    def _can_take(self, serial: int, last: int, tick: int) -> bool:
        """Check whether the message with a given serial can be taken or skipped at `tick`.

        A bad message is skipped if the visible tick in its slot is later than any that a valid
        message can have.

        Args:
            serial: Serial of the message.
            last: Newest serial that the writer has published.
            tick: Release tick of the reading cycle.
        """
        if serial > last:
            return False
        ticks_ahead = self.slots.read_visible_tick(serial) - tick
        return ticks_ahead <= 0 or (
            ticks_ahead > self._farthest and not self.slots.fetch_message(serial)
        )

    def close(self) -> None:
        """Release the claim on the mailbox with the reader's position."""
        self._position.close()
