"""Watching what comes through a mailbox: every message that has become visible since the last read, in serial order.

A fault shows by evidence that no delay of the machine can make: a serial whose slot was never filled, a later serial
of an earlier tick, two messages for one release, a message stamped behind the end of the cycle that made it.
"""

from __future__ import annotations

from zlib import crc32

from backplane.alarms import Alarm
from backplane.cycle_record import CycleRecord
from backplane.episodes import Episodes
from backplane.mailbox import Reader
from backplane.segment import Segment
from backplane.words import Slot

LONG_AGO = -(1 << 62)
"""Tick of the message before the first."""
# Plain integers for the hot path.
_STAMP, _CRC, _SERIAL, _TICK, _VISIBLE = (
    int(Slot[name]) for name in ("STAMP_NS", "CRC", "SERIAL", "TICK", "VISIBLE_AT")
)


class MessageWatch:
    """Judges the messages of one mailbox for one reader; those before its first read are not judged.

    `seen` is the serial of the newest message judged; -1 before the first read.
    """

    def __init__(self, segment: Segment, reader: Reader, episodes: Episodes) -> None:
        self.seen = -1
        self._reader, self._spec, self._episodes = reader, reader.spec, episodes
        self._slots = reader.slots
        self._heads_and_bodies = reader.slots.heads_and_bodies()
        self._cycles = CycleRecord(segment, reader.spec.writer)
        self._newest = LONG_AGO
        self._is_sliced = reader.spec.protocol == "time-slice"
        # A message is late from there on: at once visible, it carries the tick at which it was written.
        self._late_from = self._spec.delay + self._is_sliced
        self._corrupt = self._forged = self._held_up = 0

    def judge(self, tick: int) -> None:
        """Judge what the reader has found in its read at `tick`."""
        found = self._reader.found
        if self.seen < 0:
            self._begin(found)
        elif found > self.seen:
            if found - self.seen > 1 and self._is_babble(found, tick):
                self._begin(found)
            else:
                self._walk(found, tick)
        self._account(tick)

    def _begin(self, serial: int) -> None:
        """Judge what comes behind a serial, and nothing before it."""
        self.seen = serial
        if serial and self._slots.holds(serial):
            self._newest = self._slots.head_words(serial)[_TICK]

    def _is_babble(self, found: int, tick: int) -> bool:
        """Say whether there are more messages than releases for them, but for one."""
        slots = self._slots
        if slots.head_words(found)[_SERIAL] > found:
            # Overwritten already: nobody who writes once a cycle is that fast.
            found = slots.box[0]
        if not slots.holds(found):
            return False
        every = self._spec.every
        count, cycles = found - self.seen, (slots.head_words(found)[_TICK] - self._newest) // every
        if count <= cycles + 1:
            return False
        self._find(Alarm.BABBLE, tick, count / max(1, cycles))
        return True

    def _walk(self, found: int, tick: int) -> None:
        """Judge one message after the other, up to the newest found."""
        heads_and_bodies, mask, taken, late = (
            self._heads_and_bodies,
            self._slots.mask,
            self._reader.serial,
            self._late_from,
        )
        # What a late reader finds overwritten cannot be judged.
        for serial in range(max(self.seen, self._slots.box[0] - mask) + 1, found + 1):
            head, body = heads_and_bodies[serial & mask]
            released = head[_TICK]
            # The reader has checked the message that it took, and only that.
            if (
                head[_SERIAL] == serial
                and self._newest < released > head[_VISIBLE] - late
                and (serial == taken or crc32(body) == head[_CRC])
            ):
                self._newest = released
            elif not self._judge_odd(serial, head, tick):
                break
            self.seen = serial

    def _judge_odd(self, serial: int, head: memoryview, tick: int) -> bool:
        """Judge a message that is not as most are; False when it is too early to."""
        newest, released = self._newest, head[_TICK]
        if head[_SERIAL] == serial:
            if released < newest:
                self._find(Alarm.DISORDER, tick, newest - released, since=released)
            elif head[_VISIBLE] - released >= self._late_from:
                self._judge_late(released, head[_VISIBLE], head[_STAMP], tick)
            self._newest = max(released, newest)
        elif self._is_lost(serial):
            # In its slot it would be visible from here on at the earliest: until then it may not be missed.
            if self._is_sliced and newest + self._spec.every + self._spec.delay > tick:
                return False
            self._newest = newest + self._spec.every
            self._find(Alarm.GAP, tick, 1)
            return True
        if self._is_damaged(serial):
            self._find(Alarm.DAMAGED, tick)
        return True

    def _is_lost(self, serial: int) -> bool:
        """Say whether a slot was never filled with its message: it is empty, or holds another one, whole."""
        return self._slots.head_words(serial)[_SERIAL] == 0 or self._slots.is_whole(serial)

    def _judge_late(self, released: int, visible: int, stamp_ns: int, tick: int) -> None:
        """Tell a message that was held back from one that was finished late: its cycle had ended before."""
        ended_ns = self._cycles.ended_ns(released)
        if ended_ns is not None and stamp_ns > ended_ns:
            self._find(Alarm.HELD_BACK, tick, visible - released - self._spec.delay, since=released)

    def _is_damaged(self, serial: int) -> bool:
        slots = self._slots
        # Twice: a forged message may just be overwritten by the true one, or any by one a whole ring later.
        return not (slots.is_whole(serial) or slots.is_whole(serial)) and slots.box[0] - serial < slots.mask

    def _account(self, tick: int) -> None:
        """Tell of what the reader itself has found since the last time."""
        reader = self._reader
        if reader.corrupt != self._corrupt:
            self._corrupt = reader.corrupt
            self._find(Alarm.DAMAGED, tick)
        if reader.forged != self._forged:
            self._forged = reader.forged
            self._find(Alarm.MASQUERADE, tick, reader.forger)
        if reader.held_up != self._held_up:
            self._held_up = reader.held_up
            self._find(Alarm.LOCKED, tick)

    def _find(self, code: Alarm, tick: int, value: float = 0.0, since: int | None = None) -> None:
        self._episodes.find(code, self._reader.accesses, tick, value, since)
