"""Checks on the messages of a mailbox: each one that has become visible since the last read, in
serial order.

A fault is reported only on evidence that a slow machine cannot produce: a serial whose slot was
never filled, a later serial with an earlier tick, two messages for one release, a message stamped
after the end of the cycle that made it. The reader may be delayed too. So a message is copied
first, then its slot must still be its own (`Slots.keeps`), and only then is the copy judged.
"""

from __future__ import annotations

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.address_map import oldest_kept
from rack.backplane.mailbox.mailbox import Reader, ReaderState
from rack.backplane.mailbox.queue import QueueReader
from rack.backplane.mailbox.slots import CHECKED_FROM, UNSIGNED
from rack.backplane.segment import Segment
from rack.backplane.trace import CycleRecord
from rack.backplane.watch.alarms import Alarm, Episodes
from rack.backplane.words import Slot, Word

LONG_AGO = -(1 << 62)
"""Tick of the message before the first."""


class MessageWatch:
    """Judges the messages of one mailbox for one reader; those before its first read are not
    judged.

    `seen` is the serial of the newest message judged, -1 before the first read; `newest` is its
    release tick. Both are words of the reader's state.
    """

    seen = Word(ReaderState.JUDGED)
    newest = Word(ReaderState.JUDGED_TICK)

    def __init__(self, segment: Segment, reader: Reader, episodes: Episodes) -> None:
        self._reader = reader
        self._episodes = episodes
        self.words = reader.words
        self.seen = -1
        self._spec = reader.spec
        self._slots = reader.slots
        self._cycles = CycleRecord(segment, reader.spec.writer)
        self.newest = LONG_AGO
        self._is_sliced = reader.spec.is_by_ticks
        # From this delay on a message is late. A message visible at once carries the tick at which
        # it was written.
        self.late_from = self._spec.delay + self._is_sliced
        self._held_up = 0

    def judge(self, tick: int) -> None:
        """Judge the messages found by the read at `tick`."""
        found = self._reader.found
        if self.seen < 0:
            self._begin(found)
        elif found > self.seen:
            if found - self.seen > 1 and self._is_babble(found, tick):
                self._begin(found)
            else:
                self._walk(found, tick)
        if self._reader.statistics.held_up != self._held_up:
            self._held_up = self._reader.statistics.held_up
            self._find(Alarm.LOCKED, tick)

    def _begin(self, serial: int) -> None:
        """Judge messages after a serial, and none before it."""
        self.seen = serial
        if serial and self._copies(serial):
            self.newest = self._slots.tick

    def _copies(self, serial: int) -> bool:
        """Copy a message into the local record; False when it is missing or cannot be trusted."""
        return self._slots.fetch(serial) and self._slots.keeps(serial)

    def _is_babble(self, found: int, tick: int) -> bool:
        """Say whether there are more messages than releases, by more than one."""
        slots = self._slots
        if not slots.keeps(found):
            # Already overwritten: a writer of one message per cycle is not that fast.
            found = slots.box[0]
        if not self._copies(found):
            return False
        count = found - self.seen
        cycles = (slots.tick - self.newest) // self._spec.every
        if count <= cycles + 1:
            return False
        self._find(Alarm.BABBLE, tick, count / max(1, cycles))
        return True

    def _walk(self, found: int, tick: int) -> None:
        """Judge the messages one by one, up to the newest found."""
        slots = self._slots
        mask = slots.mask
        taken = self._reader.serial
        late = self.late_from
        # A late reader cannot judge messages that are overwritten.
        for serial in range(max(self.seen + 1, oldest_kept(slots.box[0], slots.depth)), found + 1):
            head = slots.heads[serial & mask]
            released = head[Slot.TICK]
            # The reader has checked the message that it took, and only that one.
            if (
                head[Slot.SERIAL] == serial
                and self.newest < released > head[Slot.VISIBLE_AT] - late
                and (
                    serial == taken
                    or xxh3(slots.places[serial & mask][CHECKED_FROM:], head[Slot.CHAIN] & UNSIGNED)
                    == head[Slot.CHECK] & UNSIGNED
                )
                and slots.keeps(serial)
            ):
                self.newest = released
            elif not self._judge_odd(serial, tick):
                break
            self.seen = serial

    def _judge_odd(self, serial: int, tick: int) -> bool:
        """Judge an unusual message; False when it is too early to judge."""
        slots = self._slots
        # A second look if it is not whole: the true message may just be overwriting a forged one.
        if not slots.copy(serial) or not (slots.is_sound or slots.copy(serial)):
            return True
        expected = self.newest + self._spec.every
        if slots.serial == serial and slots.is_sound:
            self._judge_time(slots.tick, slots.visible, tick)
        elif slots.serial == 0 or slots.is_sound:
            # Its slot is empty, or holds another whole message: it is lost. It is not missing
            # before the first tick at which it would have been visible.
            if self._is_sliced and expected + self._spec.delay > tick:
                return False
            self.newest = expected
            self._find(Alarm.GAP, tick, 1)
        else:
            if slots.serial == serial:
                # Its release tick may be damaged too; no release is later than now.
                self.newest = max(self.newest, min(slots.tick, tick))
            self._find(Alarm.DAMAGED, tick)
        return True

    def _judge_time(self, released: int, visible: int, tick: int) -> None:
        """Judge the release and the arrival of the message in the local record."""
        if released < self.newest:
            self._find(Alarm.DISORDER, tick, self.newest - released, since=released)
        elif visible - released >= self.late_from:
            # Held back, not just finished late, if its cycle had ended before it was published.
            ended_ns = self._cycles.ended_ns(released)
            if ended_ns is not None and self._slots.stamp_ns > ended_ns:
                self._find(
                    Alarm.HELD_BACK, tick, visible - released - self._spec.delay, since=released
                )
        self.newest = max(released, self.newest)

    def _find(self, code: Alarm, tick: int, value: float = 0.0, since: int | None = None) -> None:
        self._episodes.find(code, self._reader.accesses, tick, value, since)


class QueueWatch(MessageWatch):
    """Judges the messages that the reader of a queue has taken, several of one release among
    them.
    """

    def __init__(self, segment: Segment, reader: QueueReader, episodes: Episodes) -> None:
        super().__init__(segment, reader, episodes)
        self._queue = reader
        self._lost = 0
        self.seen = reader.taken

    def judge(self, tick: int) -> None:
        """Judge the messages taken by the read at `tick`."""
        queue = self._queue
        slots = self._slots
        for serial in range(self.seen + 1, queue.taken + 1):
            # Its slot is the writer's again only when the writer learns that it has been taken.
            head = slots.heads[serial & slots.mask]
            if head[Slot.SERIAL] != serial:
                continue
            released = head[Slot.TICK]
            if self.newest <= released > head[Slot.VISIBLE_AT] - self.late_from:
                self.newest = released
            elif slots.copy(serial):
                self._judge_time(released, head[Slot.VISIBLE_AT], tick)
        self.seen = queue.taken
        if queue.statistics.lost != self._lost:
            lost = queue.statistics.lost - self._lost
            self._lost = queue.statistics.lost
            self._find(Alarm.GAP, tick, lost)
