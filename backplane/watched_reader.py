"""Readers that watch their mailbox: every read also looks at what came, and at what did not come."""

from __future__ import annotations

from collections.abc import Iterator

from rack.backplane.address_map import CLOCK
from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.episodes import Episodes
from rack.backplane.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.backplane.message_watch import MessageWatch
from rack.backplane.protocols import open_reader
from rack.backplane.segment import Segment
from rack.backplane.silence_watch import SilenceWatch, Witness
from rack.backplane.slots import Slots
from rack.backplane.words import Block

_LOST = int(Block.LOST)


def watched(segment: Segment, name: str, alarms: AlarmWriter, witness: Witness) -> WatchedReader | SporadicReader:
    """Open a mailbox for a task, watched as its writer permits: what the clock writes comes now and then."""
    if segment.layout.mailbox(name).writer == CLOCK:
        return SporadicReader(segment, name, alarms)
    return WatchedReader(segment, name, alarms, witness)


class WatchedReader:
    """Reads a mailbox for a task, and rings the task's alarms about it. A clean read costs three comparisons."""

    def __init__(self, segment: Segment, name: str, alarms: AlarmWriter, witness: Witness) -> None:
        self.reader = reader = open_reader(segment, name)
        episodes = Episodes(segment, name, alarms)
        self._messages = MessageWatch(segment, reader, episodes)
        self._silence = SilenceWatch(segment, reader, episodes, witness)
        self._quiet = self._silence.quiet
        self._writer = segment.block(reader.spec.writer)
        self._bad_reads = 0
        self._lost = {verdict: Reading(reader.message, verdict, True) for verdict in Verdict}

    def read(self, tick: int) -> Reading:
        """Return the newest message visible at `tick`, with its verdict, and whether its writer is lost."""
        reader = self.reader
        reading = reader.read(tick)
        if reader.found > self._messages.seen or reader.bad_reads != self._bad_reads:
            self._bad_reads = reader.bad_reads
            self._messages.judge(tick)
        if (tick - reader.newest >= self._quiet or self._writer[_LOST]) and self._silence.is_lost(tick):
            return self._lost[reading.verdict]
        return reading


class SporadicReader:
    """Reads an operator's mailbox: silence there proves nothing, but what comes must be whole, and the clock's.

    A command may leave standing what an earlier one said, so none is left out: the newest comes with those before it
    that have not been read; at first with all that are there, for a board that comes back must know them.
    """

    def __init__(self, segment: Segment, name: str, alarms: AlarmWriter) -> None:
        self.reader = open_reader(segment, name)
        self._slots = Slots(segment, self.reader.spec)
        self._episodes = Episodes(segment, name, alarms)
        self._bad_reads = self._corrupt = self._forged = 0

    def read(self, tick: int) -> Reading:
        """Return the newest message visible at `tick`, with its verdict, and those that came before it."""
        before = self.reader.serial
        reading = self.reader.read(tick)
        if self.reader.bad_reads != self._bad_reads:
            self._tell(tick)
        if self.reader.serial > before + 1:
            return reading._replace(earlier=tuple(self._between(before, self.reader.serial)))
        return reading

    def _between(self, before: int, newest: int) -> Iterator[Message]:
        """Yield a copy of each good message between two serials, as far as the slots reach back."""
        slots = self._slots
        for serial in range(max(before + 1, newest - slots.mask), newest):
            if slots.fetch(serial) and slots.is_lawful(0):
                message = Message(slots.dtype)
                message.copy_from(slots.message)
                yield message

    def _tell(self, tick: int) -> None:
        reader, self._bad_reads = self.reader, self.reader.bad_reads
        if reader.corrupt != self._corrupt:
            self._corrupt = reader.corrupt
            self._episodes.find(Alarm.DAMAGED, reader.accesses, tick)
        if reader.forged != self._forged:
            self._forged = reader.forged
            self._episodes.find(Alarm.MASQUERADE, reader.accesses, tick, reader.forger)
