"""Exports and imports: each passes one mailbox between backplane and network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rack.backplane.mailbox.host_ring import has_permitted_values
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import AnyMessage, Message, fill_counts
from rack.backplane.segment import Segment
from rack.backplane.words import Box, encode_switch
from rack.boards.host.entries import NEVER, zero_counts
from rack.boards.lan.config import ExportConfig, ImportConfig
from rack.boards.lan.envelope import Envelope, Flaw, Sealer, compute_kind
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import LanLink, ReceivedMessage
from rack.boards.lan.lockstep import Barrier
from rack.boards.lan.peers import NO_LAUNCH, PeerRack
from rack.boards.lan.status import LanExport, LanImport
from rack.levels.ports import Sender

NUMBER_LIMIT = 1 << 62
"""Exclusive upper limit of valid launch, serial and message numbers. Larger values are forged."""


WINDOW_MESSAGES = 64
"""Number of recent message numbers whose arrival is remembered."""
_WHOLE = (1 << WINDOW_MESSAGES) - 1


class SequenceTracker:
    """Tracks the message numbers of one import and counts gaps, repeats and late arrivals.

    Attributes:
        count: Counters of the import, with number and serial of the newest message.
        launch: Launch of the newest message: see `Envelope`.
    """

    def __init__(self, count: LanImport) -> None:
        self.count = count
        self.launch = NO_LAUNCH
        self._arrived = 0  # bit n is set if message `number` - n has arrived

    def restore_counts(self, record: Any) -> None:
        """Resume tracking after the newest message that the previous adapter has counted.

        All earlier messages are treated as received.
        """
        self.count.record[...] = record
        self.launch = self.count.launch
        self._arrived = _WHOLE

    def accept_message(self, head: Envelope) -> bool:
        """Update the counters for a received message, and check whether to deliver it.

        Returns:
            True if the message is newer than all received before. Message numbers that were skipped
            are counted as missing. False if it is not, and the message is counted as repeated or
            disordered.
        """
        count = self.count
        if head.launch != self.launch:
            # A new launch starts a new sequence. The messages that it sent before this one are not
            # counted as missing. If a serial is known but no launch, the counters were resumed from
            # a status in lockstep, which contains no launch. The launch is then still the same.
            if self.launch != NO_LAUNCH or not count.serial:
                count.number = head.number
                count.serial = 0
                self._arrived = 0
            self.launch = head.launch
        # A restarted sender may use a number twice, so the serial decides which message is newer.
        step = head.number - count.number
        if head.serial <= count.serial:
            bit = 1 << min(max(0, -step), WINDOW_MESSAGES)
            if head.serial == count.serial or self._arrived & bit:
                count.repeated += 1
            else:
                count.disordered += 1
                self._arrived |= bit & _WHOLE
            return False
        count.missing += max(0, step - 1)
        self._arrived = (self._arrived << min(max(0, step), WINDOW_MESSAGES) | 1) & _WHOLE
        count.number = head.number
        count.serial = head.serial
        return True


class Counted:
    """Part of the network adapter whose counters are a group of the adapter's status."""

    count: Message

    def restore_counts(self, record: Any) -> None:
        """Restore the counters from the last status of the previous adapter."""
        self.count.record[...] = record

    def write_counts(self, record: Any) -> None:
        """Write the counters into their group of the adapter's status."""
        fill_counts(record, self.count.record.item())


class Export(Counted):
    """Sends the messages of one mailbox of this rack.

    Attributes:
        every: Period of the exchange in cycles of the adapter.
        must_resend: Whether a rack has joined since the last message was sent, so that the newest
            message must be sent even if it was sent before.
        count: Counters of the export.
    """

    def __init__(self, segment: Segment, table: ExportConfig, launch: int, grid: OwnGrid) -> None:
        self._source = open_observer(segment, table.source)
        spec = self._source.spec
        self._kind = compute_kind(
            spec.message, spec.version, build_message_dtype(spec.fields, spec.size)
        )
        self._launch = launch
        self._key = out_key(segment.rack, table.source)
        self._grid = grid
        self.every = grid.compute_period_cycles(table.rate_hz)
        self.must_resend = False
        self.count: LanExport = zero_counts(LanExport)
        self._put: Callable[[bytes, bytes], None]

    def open(self, carrier: LanLink | Barrier, sealer: Sealer) -> None:
        """Start publishing through a network link or, in lockstep, through a barrier."""
        self._put = carrier.publish(self._key)
        self._sealer = sealer

    def resend_last(self, tick: int, cycle_ticks: int) -> None:
        """Send again the message that the previous adapter sent at `tick`, if it sent one.

        Args:
            tick: Release of the last cycle of the previous adapter.
            cycle_ticks: Length of the adapter's cycle in ticks.
        """
        if (tick // cycle_ticks) % self.every:
            return
        self._source.read(tick - self.every * cycle_ticks)
        previous_serial = self._source.serial
        self._source.read(tick)
        if self._source.serial == self.count.serial != previous_serial:
            self.count.sent -= 1
            self.count.serial = previous_serial
            self.send_newest(tick)

    def send_newest(self, tick: int) -> None:
        """Send the mailbox's newest message if it was not sent before.

        In real time, a message that was sent before is sent again if `must_resend` is set.
        """
        # Read the mailbox directly, because a port gives neither the serial nor the written tick.
        source = self._source
        grid = self._grid
        reading = source.read(tick)
        if not reading.has_message:
            return
        count = self.count
        if source.serial != count.serial:
            count.sent += 1
            count.serial = source.serial
        elif not self.must_resend or grid.is_lockstep:
            return
        self.must_resend = False
        written_tick = source.newest
        payload = bytes(reading.message.raw)
        stamp_ns = grid.stamp_ns(written_tick)
        head = Envelope(
            self._kind,
            self._launch,
            count.serial,
            count.sent,
            written_tick,
            grid.time_ns(written_tick),
            stamp_ns,
            age_ns=stamp_ns - grid.stamp_ns(min(source.basis, written_tick)),
        )
        self._put(payload, self._sealer.seal(self._key, head, payload))


class Import:
    """Receives the messages of one mailbox of another rack.

    Each exchange writes the newest valid message to the mailbox `lan.<port>`. From the loss of the
    other rack until its first message after its return, the mailbox is marked as away: readers see
    its writer as lost or, with `on_peer_loss = "go on"`, keep the last message, however old.

    Attributes:
        every: Period of the exchange in cycles of the adapter.
        count: Counters of the import.
    """

    def __init__(
        self, segment: Segment, mailbox: str, table: ImportConfig, peer: PeerRack, grid: OwnGrid
    ) -> None:
        spec = segment.layout.find_mailbox(mailbox)
        dtype = build_message_dtype(spec.fields, spec.size)
        self._kind = compute_kind(spec.message, spec.version, dtype)
        self._buffer = AnyMessage(dtype)
        self._key = out_key(table.rack, table.mailbox)
        self._fields = spec.fields
        self._max_age = spec.max_age
        self._delay = spec.delay
        self._peer = peer
        self._box = segment.get_box(mailbox)
        self._word = int(Box.KEPT if peer.keeps_messages else Box.VOID)
        self._is_away = bool(self._box[self._word] & 1)
        self._losses = peer.losses
        self._grid = grid
        self.every = grid.compute_period_cycles(table.rate_hz)
        self._basis: int | None = None
        # Newest message that arrived before it could be accepted, with the tick of its arrival.
        self._early: list[tuple[int, ReceivedMessage]] = []
        self.count = zero_counts(LanImport)
        self._order = SequenceTracker(self.count)
        self._arrived: Callable[[], Iterator[ReceivedMessage]]

    def restore_counts(self, record: Any, tick: int) -> None:
        """Restore the state from the status that the previous adapter wrote at `tick`."""
        self._order.restore_counts(record)
        age = self.count.age
        self._basis = None if age == NEVER else tick - age

    def open(self, carrier: LanLink | Barrier, sealer: Sealer) -> None:
        """Subscribe through a network link or, in lockstep, through a barrier."""
        self._arrived = carrier.subscribe(self._key)
        self._sealer = sealer

    def is_old(self, tick: int) -> bool:
        """Return True if the newest message is too old for the import. False if there is none."""
        return self._basis is not None and tick - self._basis > self._max_age

    def update_presence(self, tick: int) -> None:
        """Mark the mailbox as away if its rack was lost since the last call."""
        if self._peer.losses != self._losses:
            self._losses = self._peer.losses
            self._set_away(True, tick + self._delay if self._grid.is_lockstep else tick)

    def mark_present(self, tick: int) -> None:
        """Mark the mailbox as present from the tick at which this cycle's message is visible."""
        self._set_away(False, tick + self._delay)

    def _set_away(self, is_away: bool, tick: int) -> None:
        """Mark the mailbox as away or as present from `tick` on, unless it already is."""
        if is_away != self._is_away:
            self._is_away = is_away
            self._box[self._word] = encode_switch(tick, is_away)

    def deliver_newest(self, out: Sender[AnyMessage], tick: int) -> None:
        """Check the messages that have arrived, and write the newest valid one if recent enough.

        Args:
            out: Output port of the import.
            tick: Current tick.
        """
        waiting = [*self._early, *((tick, arrived) for arrived in self._arrived())]
        self._early = []
        newest: Envelope | None = None
        for arrival_tick, arrived in waiting:
            head = self._open_message(arrived)
            if (
                head is not None
                and self._is_acceptable(head, arrived, arrival_tick, tick)
                and self._keep_if_newest(head, arrived.payload)
            ):
                self.count.superseded += newest is not None
                newest = head
        if newest is None:
            return
        # The uncertainty of the clocks may place it in the future.
        basis = min(tick, self._grid.to_local_ns(newest, self._peer) // self._grid.clock_ns)
        if tick - basis > self._max_age:
            self.count.late += 1
            return
        self.count.taken += 1
        self._basis = basis
        self.count.origin_s = self._grid.to_local_ns(newest, self._peer, newest.age_ns) * 1e-9
        out.message.raw[:] = self._buffer.raw
        # Ticks of mailboxes cannot be negative, but the message may predate this rack's tick 0.
        out.send(max(0, basis))
        self.mark_present(tick)

    def _open_message(self, arrived: ReceivedMessage) -> Envelope | None:
        """Check a received message and return its envelope.

        If the seal, the type, the length or a number is invalid, count the message as refused and
        return None.
        """
        head = self._sealer.open_message(*arrived)
        if (
            not isinstance(head, Flaw)
            and head.kind == self._kind
            and len(arrived.payload) == len(self._buffer.raw)
            and max(head[1:4]) < NUMBER_LIMIT
        ):
            return head
        self.count.refused += 1
        return None

    def _is_acceptable(
        self, head: Envelope, arrived: ReceivedMessage, arrival_tick: int, tick: int
    ) -> bool:
        """Return True if a message comes from the present launch and its age is known.

        In lockstep every message is acceptable: see `Barrier`. Otherwise, a message that is not
        acceptable yet but may become so is stored for a later cycle, in place of the one stored
        before. A message that cannot become acceptable is counted as coming from an unknown launch.

        Args:
            head: Envelope of the message.
            arrived: The message as received.
            arrival_tick: Tick at which it arrived.
            tick: Current tick.
        """
        if self._grid.is_lockstep:
            return True
        if head.launch in self._peer.superseded or tick - arrival_tick > self._max_age:
            self.count.unknown_launch += 1
            return False
        # Until the clocks have been compared, the age of the message is unknown.
        if self._is_present_launch(head) and self._peer.offset_ns is not None:
            return True
        for _, kept_message in self._early:
            kept_head = self._open_message(kept_message)
            if kept_head is not None and self._is_present_launch(kept_head):
                # Record its arrival, so that it is not counted as missing.
                self.count.superseded += self._order.accept_message(kept_head)
            else:
                self.count.unknown_launch += 1
        self._early = [(arrival_tick, arrived)]
        return False

    def _is_present_launch(self, head: Envelope) -> bool:
        """Return True if a message comes from the present launch of its rack."""
        return self._peer.is_present and head.launch == self._peer.launch

    def _keep_if_newest(self, head: Envelope, payload: bytes) -> bool:
        """Store a message if its values are permitted and it is newer than all received before.

        Returns:
            True if it was stored. Otherwise it is counted as refused, repeated or disordered.
        """
        message = AnyMessage(self._buffer.record.dtype, memoryview(bytearray(payload)))
        if not has_permitted_values(message.record, self._fields):
            self.count.refused += 1
            return False
        if not self._order.accept_message(head):
            return False
        self._buffer.copy_from(message)
        return True

    def write_counts(self, record: Any, tick: int) -> None:
        """Write the counters and the newest message's age into their group of the status."""
        count = self.count
        count.launch = NO_LAUNCH if self._grid.is_lockstep else self._order.launch
        count.age = NEVER if self._basis is None else tick - self._basis
        count.age_s = NEVER if count.age == NEVER else count.age * (self._grid.clock_ns * 1e-9)
        fill_counts(record, count.record.item())
