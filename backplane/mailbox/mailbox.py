"""Mailboxes: one writer, many readers, three protocols behind one interface.

The writer fills `writer.message` and calls `write(tick)`; a reader calls `read(tick)` and gets a
`Reading`: the message and a verdict. `tick` is the release tick of the cycle that calls, so that
under time-slice what is read depends on ticks alone, never on how fast a process happened to run.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from rack.backplane.byte_lock import ByteLock
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.slots import Slots, claim, pid_of
from rack.backplane.message import Message
from rack.backplane.segment import Segment
from rack.backplane.words import Box

NOT_YET = 1 << 62
"""Tick of the newest message before there is any: its age is below zero, so that nobody finds it too old."""
MAX_STEP_BACK = 4
"""Messages that a read tries before a bad one: its work stays bounded."""


class Verdict(IntEnum):
    """What a read found."""

    NONE = 0  # no message has come yet
    OLD = 1  # the message of an earlier read again
    NEW = 2  # a message not read before
    BUS_ERROR = 3  # the access was cut off by its bound; the value is the last good one, and there is one


class Reading(NamedTuple):
    """What a read gave: the message, all zero before the first one, and the verdict.

    `is_lost`: its writer is dead, hangs, or has been silent for longer than a writer of its period may be. `earlier`:
    where every message counts, those before it that have not been read yet, oldest first.
    """

    value: Message
    verdict: Verdict
    is_lost: bool = False
    earlier: tuple[Message, ...] = ()

    @property
    def is_new(self) -> bool:
        """True in the one cycle that reads the message first."""
        return self.verdict is Verdict.NEW

    @property
    def is_there(self) -> bool:
        """True once any message has come."""
        return self.verdict is not Verdict.NONE


class Writer:
    """The one writer of a mailbox; its base protocol is time-slice.

    Opening claims the mailbox: a second writer is refused with `MailboxError` as long as the first
    one's process lives. A new writer goes on after the last whole message, in a new epoch.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = spec = segment.layout.mailbox(name)
        self._slots = Slots(segment, spec)
        self.message = self._slots.message
        self.bus_errors = 0
        self.held_up = 0
        """Accesses so far for which a dead or stopped process had the lock."""
        self.intruder = 0
        """Process that has published in the mailbox since the last message but one of this writer; 0: none."""
        self._claim = ByteLock(segment, segment.map.mailboxes[name] + 8 * Box.CLAIM)
        if not self._claim.take():
            pid = self._slots.box[Box.WRITER_PID]
            self._claim.close()
            raise MailboxError(f"mailbox '{name}' has a writer already, process {pid}; permitted: one")
        box = self._slots.box
        box[Box.WRITER_PID] = os.getpid()
        box[Box.EPOCH] += 1
        # One store: no reader sees half a claim.
        box[Box.CLAIMANT] = claim(box[Box.EPOCH], os.getpid())
        self._slots.resume(box[Box.CLAIMANT])

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`, released at `tick`; return False when it comes too late.

        It becomes visible at `tick` + delay. When the clock, `now`, has passed that tick, it becomes
        visible from the next boundary of the writer's period.
        """
        written = self.publish(tick, self.visible_at(tick, now), tick if basis is None else basis)
        return written and (now is None or now < tick + self.spec.delay)

    def visible_at(self, tick: int, now: int | None) -> int:
        """Return the tick from which a message released at `tick` and written now is visible."""
        in_time = tick + self.spec.delay
        if now is None or now < in_time:
            return in_time
        every = self.spec.every
        return (now // every + 1) * every

    def publish(self, tick: int, visible_at: int, basis: int, damage: Sequence[int] = ()) -> bool:
        """Publish `message`, visible at that tick; return False when a bound cut it off.

        `damage`: see `Slots.publish`.
        """
        self.intruder = self._slots.publish(tick, visible_at, basis, damage)
        return True

    def lose(self) -> None:
        """Take a serial whose message is lost."""
        self._slots.lose()

    @property
    def serial(self) -> int:
        """Serial of the newest message written."""
        return self._slots.serial

    def close(self) -> None:
        """Give the claim back."""
        self._claim.close()


class ReadStatistics:
    """Counts of one reader's reads so far."""

    __slots__ = ("accesses", "bad_reads", "bus_errors", "corrupt", "forged", "forger", "held_up", "transfers")

    def __init__(self) -> None:
        self.accesses = 0
        self.transfers = 0  # messages copied
        self.bad_reads = 0  # with any of the following: one number to compare
        self.bus_errors = 0  # accesses that their bound cut off
        self.corrupt = 0  # messages that failed their CRC
        self.forged = 0  # messages of a process that does not hold the claim
        self.forger = 0  # the last such process
        self.held_up = 0  # accesses for which a dead or stopped process held the lock


class Reader:
    """A reader of a mailbox; its base protocol is time-slice. Reads are bounded by the mailbox's depth."""

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = segment.layout.mailbox(name)
        self.slots = self._fetched = Slots(segment, self.spec)
        self._box = self._fetched.box
        # The last good message has a buffer of its own: a corrupt copy never reaches it.
        self._good = Slots(segment, self.spec)
        self.message = self._good.message
        self._readings = {verdict: Reading(self.message, verdict) for verdict in Verdict}
        self._serial = 0
        self._signature = 0
        self.found = 0
        """Serial of the newest message that the last read has found, good or not."""
        self.newest = NOT_YET
        """Release tick of the last good message."""
        self.statistics = ReadStatistics()

    def read(self, tick: int) -> Reading:
        """Return the newest message visible at `tick`, with its verdict."""
        self.statistics.accesses += 1
        head = self._box[0]
        self.found = serial = self._newest_visible(head, tick)
        if serial == self._serial:
            return self._readings[Verdict.OLD if serial else Verdict.NONE]
        return self._take(serial, tick)

    def _newest_visible(self, head: int, tick: int) -> int:
        """Walk back from the newest message to the newest that is visible, or to the one already read."""
        visible_at = self._fetched.visible_at
        # Past the last slot nothing is visible any more: what was, is overwritten, and taking it fails.
        oldest, serial = max(self._serial, head - self._fetched.depth), head
        while serial > oldest and visible_at(serial) > tick:
            serial -= 1
        return serial

    def _take(self, serial: int, tick: int) -> Reading:
        if self._obtain(serial):
            return self._readings[Verdict.NEW]
        self.statistics.bad_reads += 1
        # The reader came later than the slots reach back.
        if not self._fetched.keeps(serial):
            return self._cut_off()
        self._blame(serial)
        return self._step_back(serial, tick)

    def _step_back(self, serial: int, tick: int) -> Reading:
        """Take the newest good message before one that was lost, damaged or forged, if it has not been read yet."""
        fetched, tries = self._fetched, MAX_STEP_BACK
        for older in range(serial - 1, max(self._serial, serial - fetched.depth), -1):
            if fetched.holds(older) and fetched.visible_at(older) <= tick:
                if self._obtain(older):
                    return self._readings[Verdict.NEW]
                self._blame(older)
                tries -= 1
                if not tries:
                    break
        return self._readings[Verdict.OLD if self._serial else Verdict.NONE]

    def _obtain(self, serial: int) -> bool:
        """Take a message over as the last good one; False when it is none."""
        self.statistics.transfers += 1
        fetched = self._fetched
        if not fetched.fetch(serial) or not (
            fetched.signature == self._signature or fetched.is_lawful(self._signature)
        ):
            return False
        self._good.record[:] = fetched.record
        self._serial, self._signature, self.newest = serial, fetched.signature, fetched.tick
        return True

    def _blame(self, serial: int) -> None:
        """Count what is wrong with the message that was fetched last. Another one in its place: it was lost."""
        fetched = self._fetched
        if not fetched.keeps(serial):
            return
        if not fetched.is_sound:
            # An empty slot, as at first.
            self.statistics.corrupt += fetched.serial != 0
        elif fetched.serial == serial:
            self.statistics.forged += 1
            self.statistics.forger = pid_of(fetched.signature)

    def _cut_off(self) -> Reading:
        self.statistics.bus_errors += 1
        return self._readings[Verdict.BUS_ERROR if self._serial else Verdict.NONE]

    @property
    def serial(self) -> int:
        """Serial of the last good message; 0: none."""
        return self._serial

    @property
    def basis(self) -> int:
        """Tick of the oldest information that the last good message rests on."""
        return self._good.basis

    @property
    def chain(self) -> bytes:
        """Running hash up to the last good message."""
        return self._good.chain

    def peek(self) -> Reading:
        """Return the newest whole message at once, whatever the protocol: for the host side."""
        return self._newest()

    def _newest(self) -> Reading:
        self.found = head = self._box[0]
        if head == self._serial:
            return self._readings[Verdict.OLD if head else Verdict.NONE]
        return self._take(head, NOT_YET)


class DoubleBufferWriter(Writer):
    """A writer whose message is visible as soon as it is whole."""

    def visible_at(self, tick: int, now: int | None) -> int:
        """Return the tick at which the message is written: it is visible at once."""
        return tick if now is None else now


class DoubleBufferReader(Reader):
    """A reader of the newest whole message."""

    def read(self, tick: int) -> Reading:
        """Return the newest whole message, with its verdict."""
        self.statistics.accesses += 1
        return self._newest()
