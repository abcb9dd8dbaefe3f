"""A mirror of a rack's segment in this process: a window of another machine's memory, mapped into
one's own.

What reads a segment reads a mirror too, unchanged. `refresh` fetches what has changed: the words of
the clock, control blocks and heads first, then the records that the heads count. The newest record
of a mailbox is fetched again each time: if a forged message was there, its writer has put its own
in that place.

Nothing in it is a fact about this machine: process ids are those of the other one, and so is
CLOCK_MONOTONIC.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from rack.backplane.address_map import (
    ALARM_DEPTH,
    ALARM_RECORD_SIZE,
    BLOCK_SIZE,
    FAULT_ENTRIES,
    FAULT_ENTRY_SIZE,
    LINE,
    MAILBOX_HEAD_SIZE,
    OPERATOR_ENTRIES,
    TRACE_RECORD_SIZE,
    oldest_kept,
    operator_entry_size,
    slot_stride,
)
from rack.backplane.errors import SegmentError
from rack.backplane.operator_table import OperatorTable, RequestStage
from rack.backplane.segment import MAGIC, TEXTS, VERSION, Segment
from rack.backplane.words import Block, Box, Head, System
from rack.boards.lan.questions import MOST_CONTENT, DeskAnswer, Stretch

WORDS = Stretch(0, 8 * 96)
"""The words of head, clock and utility lines."""
MOST_SIZE = 1 << 30
"""Bytes of the largest segment that is mirrored."""
NEWEST = 2
"""Messages of a mailbox that are kept up to date: the newest, and the one before in case that is
damaged."""

Fetch = Callable[[Sequence[Stretch]], tuple[list[bytes], DeskAnswer]]
"""Returns the content of stretches of the other segment, each of at most `MOST_CONTENT` bytes, and
the last answer."""


@dataclass
class MirroredRing:
    """A ring of records: the bus addresses of its head word and its records; `taken` records were
    fetched so far.

    `most` of the newest are fetched, `again` of them each time; `oldest` is the number of the
    oldest that is here with all after it.
    """

    head: int
    first: int
    stride: int
    depth: int
    most: int
    again: int = 0
    taken: int = 0
    oldest: int = 0

    def wanted(self, count: int) -> Iterator[Stretch]:
        """Yield the stretches of the records to fetch when `count` have been written."""
        first = max(self.taken + 1, count - self.most + 1, count + 2 - self.depth, 1)
        if first > self.taken + 1:
            self.oldest = first
        at_once = max(1, MOST_CONTENT // self.stride)
        while first <= count:
            place = first % self.depth
            records = min(count + 1 - first, self.depth - place, at_once)
            yield Stretch(self.first + place * self.stride, records * self.stride)
            first += records

    def is_hurried(self, count: int) -> bool:
        """Say whether its writer may have overwritten a record while it was fetched."""
        return count - self.taken > self.depth // 2 < self.most

    def took(self, count: int) -> None:
        """Note that `count` records have been fetched, or were skipped."""
        self.taken = max(0, count - self.again)


class Mirror(Segment):
    """A mirror; `is_there` says whether the rack answered last time. Its `rack` is the name by
    which users know it."""

    is_mirror = True

    def __init__(self, rack: str, fetch: Fetch) -> None:
        """Fetch the texts in its head. Raises `SegmentError` when the other program has another
        version."""
        self._fetch = fetch
        (head,), answer = fetch([WORDS])
        words = memoryview(head).cast("q")
        is_known = words[Head.MAGIC] == MAGIC and words[Head.VERSION] == VERSION
        if not is_known or not len(head) < words[Head.SIZE] <= MOST_SIZE:
            raise SegmentError(
                f"rack '{rack}': another version; this program mirrors layouts of version {VERSION}"
            )
        super().__init__(rack, mmap.mmap(-1, words[Head.SIZE]))
        self.is_there = True
        self._note(answer)
        texts = [part for at in TEXTS for part in self._cut(words[at], words[at + 1])]
        self._fill([WORDS, *texts])
        self.read_head()
        self._rings = {ring.head: ring for ring in self._all_rings()}
        # The heads of all rings: in control blocks, in the words of mailboxes, and before alarms.
        self._watched = [
            WORDS,
            *(Stretch(address, BLOCK_SIZE) for address in self.map.blocks.values()),
            *(Stretch(address, 8 * len(Box)) for address in self.map.mailboxes.values()),
            *(Stretch(address, 8) for address in self.map.alarms.values()),
        ]
        self._operator = OperatorTable(self)

    def follow(self, mailbox: str) -> None:
        """Fetch every message of a mailbox from now on, as far as its slots reach back."""
        ring = self._rings[self.map.mailboxes[mailbox] + 8 * Box.HEAD]
        ring.most = ring.depth

    def refresh(self) -> None:
        """Fetch what has changed since the last call."""
        news, answer = self._fetch(self._watched)
        self._note(answer)
        heads = _words_of(self._watched, news)
        fresh = list(self._tables(heads))
        hurried = [ring for at, ring in self._rings.items() if ring.is_hurried(heads[at])]
        for at, ring in self._rings.items():
            fresh += ring.wanted(heads[at])
            ring.took(heads[at])
        self._fill(fresh)
        if hurried:
            later = _words_of(self._watched, self._fetch(self._watched)[0])
            for ring in hurried:
                ring.oldest = max(ring.oldest, oldest_kept(later[ring.head], ring.depth))
        # Last: a head never counts more than is here.
        self._store(self._watched, news)

    def _tables(self, heads: dict[int, int]) -> Iterator[Stretch]:
        """Yield the entries of the fault and the operator table to fetch."""
        injected = min(heads[8 * System.INJECTED], FAULT_ENTRIES)
        yield from self._cut(self.map.faults, injected * FAULT_ENTRY_SIZE)
        requested = heads[8 * System.REQUESTED]
        # An entry is changed until it is issued, or its lease released; issued at once, it never
        # waited here.
        waits = any(entry.stage == RequestStage.WAITING for entry in self._operator.entries)
        is_open = waits or self._operator.leased()
        if is_open or requested != self.words[System.REQUESTED]:
            used = min(requested, OPERATOR_ENTRIES) * operator_entry_size(self.layout)
            yield from self._cut(self.map.operator, used)

    def _fill(self, stretches: Sequence[Stretch]) -> None:
        if stretches:
            self._store(stretches, self._fetch(stretches)[0])

    def _store(self, stretches: Sequence[Stretch], contents: Iterable[bytes]) -> None:
        for (address, size), content in zip(stretches, contents, strict=True):
            self.bytes[address : address + size] = content

    def _note(self, answer: DeskAnswer) -> None:
        self._hosts = answer.hosts
        self.realtime_ns = answer.realtime_ns
        """CLOCK_REALTIME of its machine when it answered."""

    @property
    def launcher_is_alive(self) -> bool:
        """Whether the rack still answers: its adapter ends with its launcher."""
        return self.is_there

    def is_locked(self, address: int) -> bool:
        """Say whether a host board lives; no other lock is mirrored."""
        hosts = [self.map.blocks[host.name] + 8 * Block.PID for host in self.layout.hosts]
        return bool(self._hosts >> hosts.index(address) & 1)

    def oldest(self, ring: int) -> int:
        """Return the number of the oldest record here of the ring whose head word is at a bus
        address."""
        return self._rings[ring].oldest

    def _cut(self, address: int, size: int) -> list[Stretch]:
        """Return a stretch in pieces that fit an answer. Raises `SegmentError` when it is not in
        the segment."""
        last = address + size
        if not 0 <= address <= last <= len(self.bytes):
            raise SegmentError(
                f"{size} bytes at {address}: outside the segment, which has {len(self.bytes)} bytes"
            )
        places = range(address, last, MOST_CONTENT)
        return [Stretch(place, min(MOST_CONTENT, last - place)) for place in places]

    def _all_rings(self) -> Iterator[MirroredRing]:
        places = self.map
        for task in self.layout.processes:
            head = places.blocks[task.name] + 8 * Block.TRACE_HEAD
            first = places.traces[task.name]
            yield MirroredRing(head, first, TRACE_RECORD_SIZE, task.depth, task.depth)
        for head in places.alarms.values():
            yield MirroredRing(head, head + LINE, ALARM_RECORD_SIZE, ALARM_DEPTH, ALARM_DEPTH)
        for box in self.layout.mailboxes:
            most = box.depth if box.name.endswith(".operator") else NEWEST
            head = places.mailboxes[box.name] + 8 * Box.HEAD
            first = places.mailboxes[box.name] + MAILBOX_HEAD_SIZE
            yield MirroredRing(head, first, slot_stride(box), box.depth, most, again=1)


def _words_of(stretches: Sequence[Stretch], contents: Iterable[bytes]) -> dict[int, int]:
    """Return the words in stretches by their bus addresses."""
    found: dict[int, int] = {}
    for (address, _), content in zip(stretches, contents, strict=True):
        found |= {address + 8 * at: word for at, word in enumerate(memoryview(content).cast("q"))}
    return found
