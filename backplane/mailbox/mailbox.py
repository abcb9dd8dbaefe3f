"""Mailboxes under logical execution time: one writer, many readers.

The writer fills `writer.message` and calls `write(tick)`. A reader calls `read(tick)` and gets a
`Reading` with message and verdict. `tick` is the release tick of the calling cycle. A message
written in the cycle released at tick T becomes visible at T + delay, the end of that cycle, however
early it was written. The result of a read therefore depends on ticks alone. A good message is one
that was written completely, by a process that held the claim, and not damaged since.

Alternatives considered: a sequence lock (a writer killed inside a write would leave its readers
spinning for ever), a kernel lock (as in the paper, at 3 to 4 times the cost: protocol `lock`), and
the newest complete message (this does not depend on ticks alone: protocol `double-buffer`). For the
memory order on which readers rely, see `slots`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, NamedTuple, TypeVar

from rack.backplane.address_map import SLOT_HEAD_SIZE
from rack.backplane.mailbox.claim import MailboxClaim
from rack.backplane.mailbox.slots import Slots, get_pid
from rack.backplane.message import AnyMessage, Message, copy_message
from rack.backplane.segment import Segment
from rack.backplane.words import Box, Word

NO_MESSAGE_TICK = 1 << 62
"""Value of a reader's `newest` before the first message.

The age computed from it is negative, so a missing first message is never too old.
"""
MAX_STEP_BACK = 4
"""Maximum number of older messages that a read tries in place of a bad one."""


class Verdict(IntEnum):
    """Result of a read."""

    NONE = 0  # no message has been received yet
    OLD = 1  # the same message as in an earlier read
    NEW = 2  # a message not read before
    BUS_ERROR = 3  # the access timed out; the message is the last good one


M = TypeVar("M", bound=Message, covariant=True)


class Reading(NamedTuple, Generic[M]):
    """Message and verdict of a read.

    Attributes:
        message: The message. All bytes are zero before the first one.
        verdict: Whether the message is new or old, or none has been received yet.
        is_lost: True if the writer is dead or hanging, or has not written for too long.
        earlier: Other messages that this read received, older than `message`, oldest first. Used
            only for queues and operators' commands, because no message of these may be skipped.
    """

    message: M
    verdict: Verdict
    is_lost: bool = False
    earlier: tuple[M, ...] = ()

    @property
    def is_new(self) -> bool:
        """True if no earlier read has returned this message."""
        return self.verdict is Verdict.NEW

    @property
    def has_message(self) -> bool:
        """True if at least one message has been received."""
        return self.verdict is not Verdict.NONE


class Writer:
    """The only writer of a mailbox, under protocol time-slice.

    A writer claims the mailbox when it is created. A second writer is refused with `MailboxError`
    while the process of the first one lives. A new writer continues after the last complete
    message, in a new epoch.
    """

    def __init__(self, segment: Segment, name: str, is_held: bool = False) -> None:
        """Open a mailbox for writing.

        Args:
            segment: Memory of the rack.
            name: Name of the mailbox.
            is_held: True for a standby, which claims the mailbox only when it takes over.

        Raises:
            MailboxError: The mailbox has another writer.
        """
        self.spec = spec = segment.layout.find_mailbox(name)
        self.slots = Slots(segment, spec)
        self._delay = spec.delay
        # Ticks from a release until its message must be written.
        self._due = spec.delay if spec.interrupt is None else spec.interrupt.due
        self.message = self.slots.message
        self.bus_errors = 0
        self.held_up = 0
        """Number of accesses that timed out because a dead or stopped process held the lock."""
        self.held = 0
        """Number of messages that injected faults hold back at present."""
        self.refused = 0
        """Number of messages refused because the queue was full. 0 for other protocols."""
        self.intruder = 0
        """Process id of an intruder, found when a message was published. 0 for none.

        An intruder is another process that has published since this writer's previous message.
        """
        self.claim = MailboxClaim(segment, self.slots)
        if not is_held:
            self._continue_after(self.claim.take())

    def take_over(self) -> None:
        """Claim the mailbox in a new epoch, even if the process of its writer is alive.

        Readers reject what that process publishes from now on. Only a standby may call this, while
        it holds the lock on the hand-over: see `rack.backplane.standby`.
        """
        claim, slots = self.claim, self.slots
        claim.try_lock()
        former = slots.box[Box.CLAIMANT]
        claim.begin_epoch(slots.find_newest(former))
        # The former writer may have published until its claim was replaced.
        slots.fence()
        head = slots.find_newest(former)
        claim.set_begun(head)
        self._continue_after(head)

    def _continue_after(self, head: int) -> None:
        """Continue after the newest message of the previous writer, which has this serial."""
        self.slots.clear_unpublished(head)
        self.slots.resume_writing(self.slots.signature, head)

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`.

        It becomes visible at `tick` + delay. If the clock has passed that tick, it becomes visible
        at the next boundary of the writer's period.

        Args:
            tick: Release tick of the cycle that writes.
            now: Current tick. None if the cycle is known to be on time.
            basis: Tick of the oldest information on which the message depends, by default
                `tick`.

        Returns:
            False if the message was published after the end of its cycle, or the access timed
            out.
        """
        visible_at = self.compute_visible_tick(tick, now)
        is_whole = self.publish_message(tick, visible_at, tick if basis is None else basis)
        return is_whole and self.is_in_time(tick, now)

    def is_in_time(self, tick: int, now: int | None) -> bool:
        """Check whether a message of the cycle released at `tick` was written in time.

        Args:
            tick: Release tick of the cycle.
            now: Current tick. None if the cycle is known to be on time.
        """
        return now is None or now < tick + self._due

    def compute_visible_tick(self, tick: int, now: int | None) -> int:
        """Return the tick from which a message is visible.

        Args:
            tick: Release tick of the cycle that writes.
            now: Current tick. None if the cycle is known to be on time.
        """
        in_time = tick + self._delay
        if now is None or now < in_time:
            return in_time
        cycle = min(self.spec.every, self._delay)
        return now + cycle - (now - self.spec.phase) % cycle

    def publish_message(
        self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()
    ) -> bool:
        """Publish `message` with the given ticks in its head.

        Args:
            tick: Release tick of the cycle that writes.
            visible_at: Tick from which the message is visible.
            basis: Tick of the oldest information on which the message depends.
            damage: Bits to flip, see `Slots.publish_message`.

        Returns:
            False if the access timed out.
        """
        self.intruder = self.slots.publish_message(tick, visible_at, basis, damage)
        return True

    def lose_message(self) -> None:
        """Publish the next serial without filling its slot, to inject the loss of a message."""
        self.slots.publish_gap()

    def iterate_outgoing(self) -> Iterator[None]:
        """Yield once for each message of this cycle. The caller publishes `message` each time.

        A queue may have any number of messages in a cycle. Other mailboxes have one.
        """
        yield

    def show_published(self) -> None:
        """Make published messages visible to readers. Does nothing except in a queue."""

    @property
    def serial(self) -> int:
        """Serial of the newest message written."""
        return self.slots.serial

    def close(self) -> None:
        """Release the claim on the mailbox."""
        self.claim.close()


@dataclass(slots=True)
class ReadStatistics:
    """Counts of one reader's failed reads."""

    bad_reads: int = 0  # reads to which any of the following applies
    bus_errors: int = 0  # accesses that timed out
    corrupt: int = 0  # messages with a wrong checksum
    forged: int = 0  # messages of a process that does not hold the claim
    forger: int = 0  # process id of the last such process
    held_up: int = 0  # accesses that timed out because a dead or stopped process held the lock
    lost: int = 0  # serials without a message; 0 except for queues


# A reader's state is private memory that the reader shares with compiled code. It consists of five
# words and the last good message with its head: see `words.Slot`.
CHECKED_SERIAL = 3
"""Index of a word in a reader's state: the newest serial that its `MessageWatch` has checked."""
CHECKED_TICK = 4
"""Index of a word in a reader's state: the release tick of that message."""
GOOD_OFFSET = 40
"""Byte offset of the last good message in a reader's state."""


class Reader:
    """Reader of a mailbox, under protocol time-slice.

    The number of slots that a read examines is limited by the mailbox's depth.

    Attributes:
        serial: Serial of the last good message, 0 before the first.
        found: Serial of the newest message found by the last read, good or not.
        newest: Release tick of the last good message.
        visible: Tick at which the last good message became visible.
        basis: Tick of the oldest information on which the last good message depends.
        accesses: Number of reads.
        transfers: Number of messages copied.
        words: The words of the reader's state, in which all these values are stored.
    """

    found = Word(0)
    accesses = Word(1)
    transfers = Word(2)
    _signature = Word(6)
    basis = Word(9)
    serial = Word(10)
    newest = Word(11)
    visible = Word(12)

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = segment.layout.find_mailbox(name)
        self.slots = slots = Slots(segment, self.spec)
        # The last good message has a separate buffer, so that a corrupt copy cannot overwrite it.
        state = memoryview(bytearray(GOOD_OFFSET + len(slots.record)))
        good = Slots(segment, self.spec, state[GOOD_OFFSET:])
        self.good = good.record
        """The last good message, with the head of its slot."""
        self.message = good.message
        self._readings = {verdict: Reading(self.message, verdict) for verdict in Verdict}
        self._new = self._readings[Verdict.NEW]
        self._unchanged = self._readings[Verdict.NONE]
        self.words = state[: GOOD_OFFSET + SLOT_HEAD_SIZE].cast("q")
        self.newest = NO_MESSAGE_TICK
        self.statistics = ReadStatistics()

    def get_reading(self, is_new: bool) -> Reading[AnyMessage]:
        """Return the last good message with verdict NEW if `is_new`, otherwise OLD or NONE.

        The verdict is NONE if no message has been received yet.
        """
        return self._new if is_new else self._unchanged

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest message visible at `tick`, with its verdict."""
        self.accesses += 1
        slots = self.slots
        serial = slots.box[0]
        if serial > self.serial:
            slots.fence()
            # Older messages are overwritten. If no slot has a visible message, fetching the serial
            # at which the loop ends will fail.
            oldest = max(self.serial, serial - slots.depth)
            while serial > oldest and slots.read_visible_tick(serial) > tick:
                serial -= 1
        return self._accept(serial, tick)

    def _accept(self, serial: int, tick: int) -> Reading[AnyMessage]:
        """Return the reading of a message or, if it is bad, of an older one as `_step_back` does.

        If the slot of the bad message is being overwritten, the read is counted as timed out, and
        the result is the last good message with verdict BUS_ERROR.

        Args:
            serial: Serial of the message found by the read. If it is not greater than the serial of
                the last good message, this message is returned again with verdict OLD or NONE. It
                may be smaller after a writer that had been stopped has stored the mailbox's head.
            tick: Release tick of the cycle that reads.
        """
        self.found = serial
        if serial <= self.serial:
            return self._unchanged
        if self._fetch_good(serial):
            return self._new
        if not self.slots.is_intact(serial):
            return self._count_timeout()
        self.statistics.bad_reads += 1
        self._count_bad_message(serial)
        return self._step_back(serial, tick)

    def _fetch_good(self, serial: int) -> bool:
        """Fetch a message and, if it is good, make it the last good one.

        Returns:
            False if the message is bad.
        """
        self.transfers += 1
        slots = self.slots
        if not slots.fetch_message(serial):
            return False
        if not slots.signature == self._signature == slots.box[Box.CLAIMANT]:
            if not slots.is_from_claimant(self._signature):
                return False
            self._unchanged = self._readings[Verdict.OLD]
        self.good[:] = slots.record
        return True

    def _step_back(self, serial: int, tick: int) -> Reading[AnyMessage]:
        """Return the newest unread good message before a bad one.

        Args:
            serial: Serial of the bad message.
            tick: Release tick of the reading cycle.

        Returns:
            The reading with this message. If there is none, the last good message again.
        """
        slots = self.slots
        tries = MAX_STEP_BACK
        for older in range(serial - 1, max(self.serial, serial - slots.depth), -1):
            if slots.has_message(older) and slots.read_visible_tick(older) <= tick:
                if self._fetch_good(older):
                    return self._new
                self._count_bad_message(older)
                tries -= 1
                if not tries:
                    break
        return self._unchanged

    def _count_bad_message(self, serial: int) -> None:
        """Count the last fetched message as damaged or forged.

        A lost message, whose slot contains another message, is not counted here, but by the
        `MessageWatch`.
        """
        slots = self.slots
        if not slots.is_intact(serial):
            return
        if not slots.passes_check:
            # An empty slot, as at the start, has serial 0.
            self.statistics.corrupt += slots.serial != 0
        elif slots.serial == serial:
            self._count_forged()

    def _count_forged(self) -> None:
        """Count the last fetched message as forged, and record the process in its signature."""
        self.statistics.forged += 1
        self.statistics.forger = get_pid(self.slots.signature)

    def _count_timeout(self) -> Reading[AnyMessage]:
        """Count a read that timed out. Returns the last good message with verdict BUS_ERROR."""
        self.statistics.bus_errors += 1
        self.statistics.bad_reads += 1
        return self._readings[Verdict.BUS_ERROR if self.serial else Verdict.NONE]

    def add_earlier(self, reading: Reading[AnyMessage], before: int) -> Reading[AnyMessage]:
        """Return a copy of `reading` whose `earlier` contains the messages that the read skipped.

        The oldest message comes first. Bad messages and messages whose slots have been reused are
        left out.

        Args:
            reading: Result of a read.
            before: Serial of the last good message before that read.
        """
        slots = self.slots
        newest = self.serial
        if newest <= before + 1:
            return reading
        serials = range(max(before + 1, newest - slots.mask), newest)
        return reading._replace(
            earlier=tuple(
                copy_message(slots.message)
                for serial in serials
                if slots.fetch_message(serial) and slots.is_from_claimant(0)
            )
        )

    def peek(self) -> Reading[AnyMessage]:
        """Return the newest complete message with its verdict, even if it is not visible yet."""
        head = self.slots.box[0]
        self.slots.fence()
        return self._accept(head, NO_MESSAGE_TICK)


class DoubleBufferWriter(Writer):
    """Writer under protocol double-buffer. A message is visible as soon as it is complete."""

    def compute_visible_tick(self, tick: int, now: int | None) -> int:
        """Return `now`, or `tick` if `now` is None: a message is visible once it is written."""
        return tick if now is None else now


class DoubleBufferReader(Reader):
    """Reader under protocol double-buffer (section 3.3 of the paper).

    It gets the newest complete message, so it reacts faster than under time-slice. In real time,
    the result of a read does not depend on ticks alone.
    """

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest complete message, with its verdict."""
        self.accesses += 1
        return self.peek()
