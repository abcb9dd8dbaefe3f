"""The reader of a queue that watches it: lost, damaged, forged and late messages, and a lost
writer.

Silence proves nothing, since a queue is written on demand. Only a writer found dead or hanging
counts as lost.
"""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.mailbox.queue import QueueReader
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.watch.message_watch import MessageWatch
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.words import Block, Slot


class QueueWatch(MessageWatch):
    """Judges the messages that the reader of a queue has taken, several of one release among
    them."""

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
        self.report(tick)


class WatchedQueue:
    """Reads a queue for its task, as many messages as the task has `room` for, and raises its
    alarms about them."""

    def __init__(
        self,
        segment: Segment,
        name: str,
        alarms: AlarmWriter,
        task: ReadingTask,
        room: Callable[[], int],
    ) -> None:
        self.reader = reader = QueueReader(segment, name)
        self._messages = QueueWatch(segment, reader, Episodes(segment, name, alarms))
        self._task = task
        self._room = room
        self._writer = segment.block(reader.spec.writer)
        self._bad_reads = 0

    def read(self, tick: int) -> Reading:
        """Take the messages visible at `tick`; the reading says whether their writer is lost."""
        reader = self.reader
        messages = self._messages
        reading = reader.take(tick, self._room(), self._task.now())
        is_bad = reader.statistics.bad_reads != self._bad_reads
        if is_bad:
            self._bad_reads = reader.statistics.bad_reads
            self._task.troubles += 1
        if is_bad or reader.taken != messages.seen:
            messages.judge(tick)
        return reading._replace(is_lost=True) if self.is_writer_lost(tick) else reading

    def is_writer_lost(self, tick: int) -> bool:
        """Say whether the writer is lost."""
        # From the tick after the loss: within that tick the answer would depend on which process is
        # faster.
        return 0 < self._writer[Block.LOST] <= tick
