"""Checks on the messages of a mailbox that have become visible since the last read.

Messages are checked in the order of their serials. A fault is reported only on evidence that a slow
machine cannot produce: a serial whose slot was never filled, a later serial with an earlier tick,
two messages for one release, or a message published after the end of the cycle that made it. The
reader may be delayed too. Therefore a message is copied first, then its slot is checked for reuse
(`Slots.is_intact`), and only then is the copy evaluated.
"""

from __future__ import annotations

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.address_map import compute_oldest_intact
from rack.backplane.mailbox.mailbox import CHECKED_SERIAL, CHECKED_TICK, Reader
from rack.backplane.mailbox.queue import QueueReader
from rack.backplane.mailbox.slots import CHECKED_FROM, UNSIGNED, get_epoch
from rack.backplane.segment import Segment
from rack.backplane.trace import CycleRecord
from rack.backplane.watch.alarms import Alarm, Episodes
from rack.backplane.words import Block, Slot, Word

LONG_AGO = -(1 << 62)
"""Release tick assumed for the message before the first one."""


class MessageWatch:
    """Checks the messages of one mailbox for one reader.

    The message found by the reader's first read, and all earlier ones, are not checked.

    Attributes:
        seen: Serial of the newest message that was checked, -1 before the first read.
        newest: Release tick of that message. Both are words of the reader's state.
        late_from: A message is late if it becomes visible at least this many ticks after its
            release.
    """

    seen = Word(CHECKED_SERIAL)
    newest = Word(CHECKED_TICK)

    def __init__(self, segment: Segment, reader: Reader, episodes: Episodes) -> None:
        self._reader = reader
        self._episodes = episodes
        self.words = reader.words
        self.seen = -1
        self._spec = reader.spec
        self._slots = reader.slots
        writer = reader.spec.writer
        copies = segment.layout.list_copies(writer)
        self._records = [CycleRecord(segment, copy.name) for copy in copies]
        self._blocks = [segment.get_block(copy.name) for copy in copies]
        self.newest = LONG_AGO
        self._is_sliced = reader.spec.is_tick_based
        # A message that is visible at once carries the tick at which it was written.
        self.late_from = self._spec.delay + self._is_sliced
        self._held_up = 0

    @property
    def _active(self) -> int:
        """Number of the copy that writes, if the writer has standbys. 0 otherwise."""
        return self._blocks[0][Block.ACTIVE] % len(self._blocks)

    def check_messages(self, tick: int) -> None:
        """Check the messages that have become visible up to the read at `tick`."""
        newest_serial = self._reader.found
        if self.seen < 0:
            self._start_after(newest_serial)
        elif newest_serial > self.seen:
            if newest_serial - self.seen > 1 and self._is_babble(newest_serial, tick):
                self._start_after(newest_serial)
            else:
                self._check_up_to(newest_serial, tick)
        if self._reader.statistics.held_up != self._held_up:
            self._held_up = self._reader.statistics.held_up
            self._record_finding(Alarm.LOCKED, tick)

    def _start_after(self, serial: int) -> None:
        """Skip the messages up to a serial. Checks continue with the message after it."""
        self.seen = serial
        slots = self._slots
        if serial and slots.fetch_message(serial) and slots.is_intact(serial):
            self.newest = slots.tick

    def _is_babble(self, newest_serial: int, tick: int) -> bool:
        """Check whether the writer has sent at least two messages more than its releases allow.

        If so, record the finding.

        Args:
            newest_serial: Newest serial found by the read.
            tick: Release tick of the reading cycle.
        """
        slots = self._slots
        if not slots.is_intact(newest_serial):
            # The message is already overwritten. A writer that sends one message per cycle would
            # be too slow for that. Use the newest message instead.
            newest_serial = slots.box[0]
        if not slots.fetch_message(newest_serial) or not slots.is_intact(newest_serial):
            return False
        count = newest_serial - self.seen
        cycles = (slots.tick - self.newest) // self._spec.every
        if count <= cycles + 1:
            return False
        self._record_finding(Alarm.BABBLE, tick, count / max(1, cycles))
        return True

    def _check_up_to(self, newest_serial: int, tick: int) -> None:
        """Check the messages one by one, up to the newest one found.

        Args:
            newest_serial: Newest serial found by the read.
            tick: Release tick of the reading cycle.
        """
        slots = self._slots
        mask = slots.mask
        # Messages that are already overwritten, because the reader is late, cannot be checked.
        for serial in range(
            max(self.seen + 1, compute_oldest_intact(slots.box[0], slots.depth)), newest_serial + 1
        ):
            head = slots.heads[serial & mask]
            released = head[Slot.TICK]
            # The reader has verified the checksum of the message that it took, but of no other.
            if (
                head[Slot.SERIAL] == serial
                and self.newest < released > head[Slot.VISIBLE_AT] - self.late_from
                and (
                    serial == self._reader.serial
                    or xxh3(slots.places[serial & mask][CHECKED_FROM:], head[Slot.CHAIN] & UNSIGNED)
                    == (head[Slot.CHECK] & UNSIGNED) ^ get_epoch(head[Slot.EPOCH])
                )
                and slots.is_intact(serial)
            ):
                self.newest = released
            elif not self._check_unusual(serial, tick):
                break
            self.seen = serial

    def _check_unusual(self, serial: int, tick: int) -> bool:
        """Record a finding if a message is lost, damaged, late or out of order.

        Returns:
            False if it is too early to decide. The message must then be checked again later.
        """
        slots = self._slots
        # If the copy is torn, copy again: the true message may be overwriting a forged one.
        if not slots.copy_slot(serial) or not (slots.passes_check or slots.copy_slot(serial)):
            return True
        expected = self.newest + self._spec.every
        if slots.serial == serial and slots.passes_check:
            self._check_timing(slots.tick, slots.visible, tick)
        elif slots.serial == 0 or slots.passes_check:
            # The slot is empty or contains another complete message, so this message is lost. Do
            # not report that before the first tick at which the message would have been visible.
            if self._is_sliced and expected + self._spec.delay > tick:
                return False
            self.newest = expected
            self._record_finding(Alarm.GAP, tick, 1)
        else:
            if slots.serial == serial:
                # The release tick may be damaged too, but no release is later than now.
                self.newest = max(self.newest, min(slots.tick, tick))
            self._record_finding(Alarm.DAMAGED, tick)
        return True

    def _check_timing(self, released: int, visible: int, tick: int) -> None:
        """Record a finding if the message in the local record is out of order or was held back.

        Args:
            released: Release tick of the message.
            visible: Tick at which the message became visible.
            tick: Release tick of the reading cycle.
        """
        if released < self.newest:
            self._record_finding(Alarm.DISORDER, tick, self.newest - released, since=released)
        elif visible - released >= self.late_from:
            # A message published after the end of its cycle was held back. Otherwise the cycle was
            # just late.
            ended_ns = self._records[self._active].find_end_ns(released)
            if ended_ns is not None and self._slots.stamp_ns > ended_ns:
                self._record_finding(
                    Alarm.HELD_BACK, tick, visible - released - self._spec.delay, since=released
                )
        self.newest = max(released, self.newest)

    def _record_finding(
        self, code: Alarm, tick: int, value: float = 0.0, since: int | None = None
    ) -> None:
        """Record a finding made in the reader's current access. See `Episodes.record_finding`."""
        self._episodes.record_finding(code, self._reader.accesses, tick, value, since)


class QueueWatch(MessageWatch):
    """Checks the messages that the reader of a queue has taken.

    Unlike other mailboxes, a queue may contain several messages of one release.
    """

    def __init__(self, segment: Segment, reader: QueueReader, episodes: Episodes) -> None:
        super().__init__(segment, reader, episodes)
        self._queue = reader
        self._lost = 0
        self.seen = reader.taken

    def check_messages(self, tick: int) -> None:
        """Check the messages taken by the read at `tick`."""
        queue = self._queue
        slots = self._slots
        for serial in range(self.seen + 1, queue.taken + 1):
            # The writer does not reuse the slot before it has read that the message was taken.
            head = slots.heads[serial & slots.mask]
            if head[Slot.SERIAL] != serial:
                continue
            released = head[Slot.TICK]
            if self.newest <= released > head[Slot.VISIBLE_AT] - self.late_from:
                self.newest = released
            elif slots.copy_slot(serial):
                self._check_timing(released, head[Slot.VISIBLE_AT], tick)
        self.seen = queue.taken
        if queue.statistics.lost != self._lost:
            lost = queue.statistics.lost - self._lost
            self._lost = queue.statistics.lost
            self._record_finding(Alarm.GAP, tick, lost)
