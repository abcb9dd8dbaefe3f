"""A reader whose mailbox is watched: every read also looks at what came, and at what did not come."""

from __future__ import annotations

from backplane.alarms import AlarmWriter
from backplane.episodes import Episodes
from backplane.mailbox import Reading, Verdict
from backplane.message_watch import MessageWatch
from backplane.protocols import open_reader
from backplane.segment import Segment
from backplane.silence_watch import SilenceWatch, Witness
from backplane.words import Block

_LOST = int(Block.LOST)


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
