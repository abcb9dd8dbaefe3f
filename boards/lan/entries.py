"""Exports and imports at work: one mailbox each, between backplane and network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rack.backplane.mailbox.host_ring import is_proper
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import AnyMessage, fill_counts
from rack.backplane.segment import Segment
from rack.backplane.words import Box, switch
from rack.boards.host.entries import NEVER
from rack.boards.lan.config import ExportConfig, ImportConfig
from rack.boards.lan.envelope import Envelope, Flaw, Sealer, kind_of
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import Arrived, LanLink
from rack.boards.lan.lockstep import Barrier
from rack.boards.lan.peers import NONE, PeerRack
from rack.boards.lan.status import LanExport, LanImport, zero_counts
from rack.levels.ports import Sender

LARGEST = 1 << 62
"""Greater than every number of a launch, serial or message: larger values are forged."""


WINDOW = 64
"""Newest messages of an import of which it is known whether they came."""
_WHOLE = (1 << WINDOW) - 1


class MessageOrder:
    """The messages of one import as they were sent: which is new, which came twice, which are
    missing.

    Attributes:
        count: Counts all of it, and holds number and serial of the newest message.
        launch: The launch of the newest message: see `Envelope`.
    """

    def __init__(self, count: LanImport) -> None:
        self.count = count
        self.launch = NONE
        self._came = 0  # bit n: message `number` - n came

    def resume(self) -> None:
        """Continue after the message in the counts; those before it count as having come."""
        self.launch = self.count.launch
        self._came = _WHOLE

    def admits(self, head: Envelope) -> bool:
        """Return True if a message is newer than all before it. Count what is missing before it, or
        else why it is not newer.
        """
        count = self.count
        if head.launch != self.launch:
            # Resumed in lockstep, where launches are not on record, it is the same one. What
            # another launch sent before its first message is not missing.
            if self.launch != NONE or not count.serial:
                count.number = head.number
                count.serial = 0
                self._came = 0
            self.launch = head.launch
        # A sender that was restarted may give one number twice.
        step = head.number - count.number
        if head.serial <= count.serial:
            bit = 1 << min(max(0, -step), WINDOW)
            if head.serial == count.serial or self._came & bit:
                count.repeated += 1
            else:
                count.disordered += 1
                self._came |= bit & _WHOLE
            return False
        count.missing += max(0, step - 1)
        self._came = (self._came << min(max(0, step), WINDOW) | 1) & _WHOLE
        count.number = head.number
        count.serial = head.serial
        return True


class Export:
    """A mailbox of this rack: each new message is sent, in every n-th cycle, n being `every`.

    `is_asked`: somebody has come who needs the newest message even if it is not new.
    """

    def __init__(self, segment: Segment, table: ExportConfig, launch: int, grid: OwnGrid) -> None:
        self._source = open_observer(segment, table.source)
        spec = self._source.spec
        self._kind = kind_of(spec.message, spec.version, message_dtype(spec.fields, spec.size))
        self._launch = launch
        self._key = out_key(segment.rack, table.source)
        self._grid = grid
        self.every = grid.cycles(table.rate_hz)
        self.is_asked = False
        self.count = zero_counts(LanExport)
        self._put: Callable[[bytes, bytes], None]

    def resume(self, record: Any) -> None:
        """Continue with the counts in the status of an adapter before this one."""
        self.count.record[...] = record

    def open(self, carrier: LanLink | Barrier, sealer: Sealer) -> None:
        """Publish it."""
        self._put = carrier.publish(self._key)
        self._sealer = sealer

    def recall(self, tick: int, ticks: int) -> None:
        """Send what an adapter before this one sent at `tick`, if it did; `ticks` are those of its
        cycle.
        """
        if (tick // ticks) % self.every:
            return
        self._source.read(tick - self.every * ticks)
        before = self._source.serial
        self._source.read(tick)
        if self._source.serial == self.count.serial != before:
            self.count.sent -= 1
            self.count.serial = before
            self.exchange(tick)

    def exchange(self, tick: int) -> None:
        """Send the newest message, if it is new or asked for."""
        # Not the reading of the port: it does not say which message it is, and when that was
        # written.
        source = self._source
        grid = self._grid
        reading = source.read(tick)
        if not reading.is_there:
            return
        count = self.count
        if source.serial != count.serial:
            count.sent += 1
            count.serial = source.serial
        elif not self.is_asked or grid.is_lockstep:
            return
        self.is_asked = False
        written = source.newest
        payload = bytes(reading.message.raw)
        times = written, grid.time_ns(written), grid.stamp_ns(written)
        head = Envelope(self._kind, self._launch, count.serial, count.sent, *times)
        self._put(payload, self._sealer.seal(self._key, head, payload))

    def fill(self, record: Any) -> None:
        """Write its counts into the group of a status."""
        fill_counts(record, self.count.record.item())


class Import:
    """A mailbox of another rack: the newest good message of each exchange becomes one here.

    Its type is that of the mailbox `lan.<port>` into which it is written. While its rack is lost,
    and until its first message after that, readers there find the writer lost or, if levels are to
    go on, the last message not too old.
    """

    def __init__(
        self, segment: Segment, own: str, table: ImportConfig, peer: PeerRack, grid: OwnGrid
    ) -> None:
        spec = segment.layout.mailbox(own)
        dtype = message_dtype(spec.fields, spec.size)
        self._kind = kind_of(spec.message, spec.version, dtype)
        self._buffer = AnyMessage(dtype)
        self._key = out_key(table.rack, table.mailbox)
        self._fields = spec.fields
        self._max_age = spec.max_age
        self._delay = spec.delay
        self._peer = peer
        self._box = segment.box(own)
        self._word = int(Box.KEPT if peer.goes_on else Box.VOID)
        self._is_away = bool(self._box[self._word] & 1)
        self._losses = peer.losses
        self._grid = grid
        self.every = grid.cycles(table.rate_hz)
        self._basis: int | None = None
        # The newest message that came before its time, with the tick at which it came.
        self._early: list[tuple[int, Arrived]] = []
        self.count = zero_counts(LanImport)
        self._order = MessageOrder(self.count)
        self._arrived: Callable[[], Iterator[Arrived]]

    def resume(self, record: Any, tick: int) -> None:
        """Continue after the status that an adapter before this one wrote at `tick`."""
        count = self.count
        count.record[...] = record
        self._order.resume()
        self._basis = None if count.age == NEVER else tick - count.age

    def open(self, carrier: LanLink | Barrier, sealer: Sealer) -> None:
        """Subscribe to it."""
        self._arrived = carrier.subscribe(self._key)
        self._sealer = sealer

    def is_old(self, tick: int) -> bool:
        """Say whether its information is older than permitted."""
        return self._basis is not None and tick - self._basis > self._max_age

    def look(self, tick: int) -> None:
        """Void what is here, or keep it, if its rack has been lost since the last look."""
        if self._peer.losses != self._losses:
            self._losses = self._peer.losses
            if not self._is_away:
                self._switch(True, tick + self._delay if self._grid.is_lockstep else tick)

    def comes(self, tick: int) -> None:
        """Let readers find it again, if it was away, with the message of this cycle."""
        if self._is_away:
            self._switch(False, tick + self._delay)

    def _switch(self, is_away: bool, tick: int) -> None:
        self._is_away = is_away
        self._box[self._word] = switch(tick, is_away)

    def exchange(self, out: Sender[AnyMessage], tick: int) -> None:
        """Take what has come, and pass the newest good message on."""
        waiting = [*self._early, *((tick, arrived) for arrived in self._arrived())]
        self._early = []
        newest: Envelope | None = None
        for came, arrived in waiting:
            head = self._opened(arrived)
            if (
                head is not None
                and self._is_due(head, arrived, came, tick)
                and self._is_next(head, arrived.payload)
            ):
                self.count.superseded += newest is not None
                newest = head
        if newest is None:
            return
        basis = self._grid.tick_of(newest, self._peer, tick)
        if tick - basis > self._max_age:
            self.count.late += 1
            return
        self.count.taken += 1
        self._basis = basis
        out.message.raw[:] = self._buffer.raw
        # Ticks of mailboxes are not negative; what was written before this rack's first one is.
        out.send(max(0, basis))
        self.comes(tick)

    def _opened(self, arrived: Arrived) -> Envelope | None:
        """Return the head of what came, if it may be a message of this mailbox; else count that it
        was refused.
        """
        head = self._sealer.opened(*arrived)
        if (
            not isinstance(head, Flaw)
            and head.kind == self._kind
            and len(arrived.payload) == len(self._buffer.raw)
            and max(head[1:4]) < LARGEST
        ):
            return head
        self.count.refused += 1
        return None

    def _is_due(self, head: Envelope, arrived: Arrived, came: int, tick: int) -> bool:
        """Return True if a message is of the launch that is there, and of known age. If it may yet
        be, keep it for later.

        In lockstep it is: see `Barrier`.
        """
        if self._grid.is_lockstep:
            return True
        if self._peer.is_over(head.launch) or tick - came > self._max_age:
            self.count.unknown_launch += 1
            return False
        # Its age decides: until the clocks have been compared it may be too old.
        if self._is_present(head) and self._peer.offset_ns is not None:
            return True
        for _, before in self._early:
            older = self._opened(before)
            if older is not None and self._is_present(older):
                # It has come, so it is not missing.
                self.count.superseded += self._order.admits(older)
            else:
                self.count.unknown_launch += 1
        self._early = [(came, arrived)]
        return False

    def _is_present(self, head: Envelope) -> bool:
        return self._peer.is_there and head.launch == self._peer.launch

    def _is_next(self, head: Envelope, payload: bytes) -> bool:
        """Return True if a message is good and the newest so far, and if so keep its content."""
        message = AnyMessage(self._buffer.record.dtype, memoryview(bytearray(payload)))
        if not is_proper(message.record, self._fields):
            self.count.refused += 1
            return False
        if not self._order.admits(head):
            return False
        self._buffer.copy_from(message)
        return True

    def fill(self, record: Any, tick: int) -> None:
        """Write its counts into the group of a status."""
        count = self.count
        count.launch = NONE if self._grid.is_lockstep else self._order.launch
        count.age = NEVER if self._basis is None else tick - self._basis
        count.age_s = NEVER if count.age == NEVER else count.age * self._grid.tick_s
        fill_counts(record, count.record.item())
