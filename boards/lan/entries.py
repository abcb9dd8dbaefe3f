"""Exports and imports at work: one mailbox each, between backplane and network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rack.backplane.mailbox.host_ring import ProperContent
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.backplane.segment import Segment
from rack.boards.lan.config import ExportConfig, ImportConfig
from rack.boards.lan.envelope import Envelope, Flaw, Sealer, kind_of
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import Arrived, LanLink
from rack.boards.lan.lockstep import Barrier
from rack.boards.lan.peers import PeerRack
from rack.levels.level import Reading

NEVER = -1


class Export:
    """A mailbox of this rack: each new message is sent, in the cycles of its exchange."""

    def __init__(self, segment: Segment, table: ExportConfig, launch: int) -> None:
        self._source = open_observer(segment, table.source)
        spec = self._source.spec
        self._kind, self._launch = kind_of(spec.message, spec.version, message_dtype(spec.fields, spec.size)), launch
        self._key = out_key(segment.rack, table.source)
        self.sent = self.serial = 0
        self._put: Callable[[bytes, bytes], None]

    def open(self, way: LanLink | Barrier, sealer: Sealer) -> None:
        """Publish it."""
        self._put, self._sealer = way.publish(self._key), sealer

    def exchange(self, reading: Reading, grid: OwnGrid, tick: int) -> None:
        """Send the message, if it is new."""
        # A reading does not say which message it is, and when that was written.
        self._source.read(tick)
        if not reading.is_there or self._source.serial == self.serial:
            return
        written = self._source.newest
        self.sent, self.serial = self.sent + 1, self._source.serial
        payload = bytes(reading.value.raw)
        head = Envelope(
            self._kind, self._launch, self.serial, self.sent, written, grid.time_ns(written), grid.stamp_ns(written)
        )
        self._put(payload, self._sealer.seal(self._key, head, payload))

    def fill(self, record: object) -> None:
        """Write its counts into the group of a status."""
        record[...] = (self.sent, self.serial)  # type: ignore[index]


@dataclass
class ImportCount:
    """What came of one import: see `rack.boards.lan.messages.IMPORT`."""

    taken: int = 0
    missing: int = 0
    repeated: int = 0
    late: int = 0
    refused: int = 0
    strange: int = 0
    overtaken: int = 0


class Import:
    """A mailbox of another rack: the newest good message of each exchange becomes one here.

    Its type is that of the mailbox `lan.<port>` into which it is written.
    """

    def __init__(self, segment: Segment, own: str, table: ImportConfig, peer: PeerRack) -> None:
        spec = segment.layout.mailbox(own)
        dtype = message_dtype(spec.fields, spec.size)
        self._kind, self._is_proper = kind_of(spec.message, spec.version, dtype), ProperContent(spec.fields)
        self._buffer = Message(dtype)
        self._peer, self._max_age, self._key = peer, spec.max_age, out_key(table.rack, table.mailbox)
        self._launch = self._number = self.serial = 0
        self._basis = NEVER
        self.count = ImportCount()
        self._arrived: Callable[[], Iterator[Arrived]]

    def open(self, way: LanLink | Barrier, sealer: Sealer) -> None:
        """Subscribe to it."""
        self._arrived, self._sealer = way.subscribe(self._key), sealer

    def exchange(self, out: Message, grid: OwnGrid, tick: int) -> None:
        """Take what has come, and pass the newest good message on."""
        newest: Envelope | None = None
        for arrived in self._arrived():
            head = self._judged(arrived)
            if head is not None:
                self.count.overtaken += newest is not None
                newest = head
        if newest is None:
            return
        basis = grid.tick_of(newest, self._peer, tick)
        if tick - basis > self._max_age:
            self.count.late += 1
            return
        self._basis = basis
        self.count.taken += 1
        out.raw[:] = self._buffer.raw
        out.send(basis)

    def _judged(self, arrived: Arrived) -> Envelope | None:
        """Return the head of a message that is good and new, with its content in the buffer; else count why not."""
        head, count = self._sealer.opened(arrived.key, arrived.envelope, arrived.payload), self.count
        if isinstance(head, Flaw) or head.kind != self._kind or len(arrived.payload) != len(self._buffer.raw):
            count.refused += 1
            return None
        if head.launch != self._peer.launch:
            count.strange += 1
            return None
        if head.launch != self._launch:
            self._launch, self._number, self.serial = head.launch, head.number - 1, 0
        if head.serial <= self.serial:
            count.repeated += 1
            return None
        message = Message(self._buffer.record.dtype, memoryview(bytearray(arrived.payload)))
        if not self._is_proper(message):
            count.refused += 1
            return None
        count.missing += max(0, head.number - self._number - 1)
        self._number, self.serial = head.number, head.serial
        self._buffer.raw[:] = message.raw
        return head

    def fill(self, record: object, grid: OwnGrid, tick: int) -> None:
        """Write its counts into the group of a status."""
        c = self.count
        age = NEVER if self._basis == NEVER else tick - self._basis
        age_s = -1.0 if age == NEVER else age * grid.tick_s
        counts = (c.taken, c.missing, c.repeated, c.late, c.refused, c.strange, c.overtaken)
        record[...] = (*counts, self.serial, age, age_s)  # type: ignore[index]
