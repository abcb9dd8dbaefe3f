"""Mailboxes: one writer, many readers, three protocols behind one interface.

The writer fills `writer.message` and calls `write(tick)`; a reader calls `read(tick)` and gets a
`Reading`: the message and a verdict. `tick` is the release tick of the cycle that calls, so that
under time-slice what is read depends on ticks alone, never on how fast a process happened to run.
"""

from __future__ import annotations

import os
from enum import IntEnum
from typing import NamedTuple

from backplane.byte_lock import ByteLock
from backplane.errors import MailboxError
from backplane.message import Message
from backplane.segment import Segment
from backplane.slots import Slots
from backplane.words import Box


class Verdict(IntEnum):
    """What a read found."""

    NONE = 0  # no message has come yet
    OLD = 1  # the message of an earlier read again
    NEW = 2  # a message not read before
    BUS_ERROR = 3  # the access was cut off by its bound; the value is the last good one, and there is one


class Reading(NamedTuple):
    """What a read gave: the message, all zero before the first one, and the verdict.

    `is_lost`: its writer is dead, hangs, or has been silent for longer than a writer of its period may be.
    """

    value: Message
    verdict: Verdict
    is_lost: bool = False

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
    one's process lives. A new writer goes on behind the last whole message, in a new epoch.
    """

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = spec = segment.layout.mailbox(name)
        self._slots = Slots(segment, spec)
        self.message = self._slots.message
        self.bus_errors = 0
        self._claim = ByteLock(segment, segment.map.mailboxes[name] + 8 * Box.CLAIM)
        if not self._claim.take():
            pid = self._slots.box[Box.WRITER_PID]
            self._claim.close()
            raise MailboxError(f"mailbox '{name}' has a writer already, process {pid}; permitted: one")
        box = self._slots.box
        box[Box.WRITER_PID] = os.getpid()
        box[Box.EPOCH] += 1
        self._slots.resume(box[Box.EPOCH])

    def write(self, tick: int, now: int | None = None, basis: int | None = None) -> bool:
        """Publish `message`, released at `tick`; return False when it comes too late.

        It becomes visible at `tick` + delay. When the clock, `now`, has passed that tick, it becomes
        visible from the next boundary of the writer's period.
        """
        visible_at = tick + self.spec.delay
        in_time = now is None or now < visible_at
        if not in_time:
            every = self.spec.every
            visible_at = (now // every + 1) * every if now is not None else visible_at
        self._slots.publish(tick, visible_at, tick if basis is None else basis)
        return in_time

    @property
    def serial(self) -> int:
        """Serial of the newest message written."""
        return self._slots.serial

    def close(self) -> None:
        """Give the claim back."""
        self._claim.close()


class Reader:
    """A reader of a mailbox; its base protocol is time-slice. Reads are bounded by the mailbox's depth."""

    def __init__(self, segment: Segment, name: str) -> None:
        self.spec = segment.layout.mailbox(name)
        self._fetched = Slots(segment, self.spec)
        self._box = self._fetched.box
        # The last good message has a buffer of its own: a corrupt copy never reaches it.
        self._good = Slots(segment, self.spec)
        self.message = self._good.message
        self._readings = {verdict: Reading(self.message, verdict) for verdict in Verdict}
        self._serial = 0
        self.accesses = 0
        self.transfers = 0
        self.corrupt = 0
        self.bus_errors = 0

    def read(self, tick: int) -> Reading:
        """Return the newest message visible at `tick`, with its verdict."""
        self.accesses += 1
        head = self._box[0]
        serial = self._newest_visible(head, tick)
        if serial == self._serial:
            return self._readings[Verdict.OLD if serial else Verdict.NONE]
        return self._take(serial)

    def _newest_visible(self, head: int, tick: int) -> int:
        """Walk back from the newest message to the newest that is visible, or to the one already read."""
        visible_at = self._fetched.visible_at
        # Past the last slot nothing is visible any more: what was, is overwritten, and taking it fails.
        oldest, serial = max(self._serial, head - self._fetched.depth), head
        while serial > oldest and visible_at(serial) > tick:
            serial -= 1
        return serial

    def _take(self, serial: int) -> Reading:
        self.transfers += 1
        if self._fetched.fetch(serial):
            self._good.record[:] = self._fetched.record
            self._serial = serial
            return self._readings[Verdict.NEW]
        # Overwritten meanwhile: the reader came later than the slots reach back. Else: damaged.
        if self._box[0] - serial >= self._fetched.mask:
            return self._cut_off()
        self.corrupt += 1
        return self._readings[Verdict.OLD if self._serial else Verdict.NONE]

    def _cut_off(self) -> Reading:
        self.bus_errors += 1
        return self._readings[Verdict.BUS_ERROR if self._serial else Verdict.NONE]

    def age_ticks(self, tick: int) -> int | None:
        """Return the ticks since the release that wrote the last good message; None before the first."""
        return tick - self._good.tick if self._serial else None

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
        head = self._box[0]
        if head == self._serial:
            return self._readings[Verdict.OLD if head else Verdict.NONE]
        return self._take(head)
