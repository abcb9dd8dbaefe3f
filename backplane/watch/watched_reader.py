"""Readers that also check their mailbox for damaged, late, forged and missing messages."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import TickGrid
from rack.backplane.mailbox.mailbox import Reader, Reading
from rack.backplane.mailbox.protocols import open_reader
from rack.backplane.mailbox.queue import UNLIMITED, QueueReader
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.watch.message_watch import QueueWatch
from rack.backplane.watch.silence_watch import ReadingTask, SilenceWatch
from rack.backplane.words import Block


def open_watched(
    segment: Segment,
    name: str,
    alarms: AlarmWriter,
    task: ReadingTask,
    *,
    count_room: Callable[[], int] = lambda: UNLIMITED,
    asynchronous: bool = False,
) -> MailboxWatcher:
    """Open a mailbox that a task reads and checks.

    The silence of the writer is checked too, except for the clock, which writes operators' commands
    at irregular times.

    Args:
        segment: Memory of the rack.
        name: Name of the mailbox.
        alarms: Alarm ring of the task.
        task: The reading task.
        count_room: Returns the maximum number of messages to take from a queue. Called before
            each read.
        asynchronous: True to read each message as soon as it is complete, under any protocol
            except queue.
    """
    spec = segment.layout.find_mailbox(name)
    if spec.protocol == "queue":
        return WatchedQueue(segment, QueueReader(segment, name), alarms, task, count_room)
    reader = open_reader(segment, name, asynchronous, task.inbox)
    kind = MailboxWatcher if spec.writer == CLOCK else WatchedReader
    return kind(segment, reader, alarms, task)


class MailboxWatcher:
    """Reader of a mailbox that raises alarms if messages are damaged or forged.

    It is used for operators' mailboxes, which the clock writes whenever a command is issued. A new
    command need not cancel the effect of an earlier one, so none is skipped: a reading has the
    newest command, and the unread ones before it in `earlier`. The first read returns all commands
    that are still in the slots, because a restarted board must know them.
    """

    def __init__(
        self, segment: Segment, reader: Reader, alarms: AlarmWriter, task: ReadingTask
    ) -> None:
        self.reader = reader
        self._episodes = Episodes(segment, reader.spec.name, alarms)
        self._task = task
        self._reported = copy(reader.statistics)

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest message visible at `tick`, and unread ones before it in `earlier`."""
        before = self.reader.serial
        reading = self.reader.read(tick)
        if self._has_trouble:
            self._report_bad_read(tick)
        return self.reader.add_earlier(reading, before)

    def is_writer_lost(self, tick: int) -> bool:
        """Return False: the writer is the clock, without which no board is released to read."""
        return False

    @property
    def _has_trouble(self) -> bool:
        """True if the last read failed or found a bad message."""
        return self.reader.statistics.bad_reads != self._reported.bad_reads

    def _report_bad_read(self, tick: int) -> None:
        """Add the last read to the task's `troubles`, and raise alarms about a bad message."""
        statistics = self.reader.statistics
        accesses = self.reader.accesses
        self._task.troubles += 1
        if statistics.corrupt != self._reported.corrupt:
            self._episodes.record_finding(Alarm.DAMAGED, accesses, tick)
        if statistics.forged != self._reported.forged:
            self._episodes.record_finding(Alarm.MASQUERADE, accesses, tick, statistics.forger)
        self._reported = copy(statistics)


class WatchedReader(MailboxWatcher):
    """Reader of a mailbox that a task writes.

    If a read finds nothing unusual, its checks cost only a few comparisons.
    """

    def __init__(
        self, segment: Segment, reader: Reader, alarms: AlarmWriter, task: ReadingTask
    ) -> None:
        super().__init__(segment, reader, alarms, task)
        self.watch = SilenceWatch(segment, reader, self._episodes, task)

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Return the newest message visible at `tick`, with its verdict and `is_lost`."""
        reader = self.reader
        reading = reader.read(tick)
        return self.check_reading(
            tick,
            reading,
            self._has_trouble or reader.found != self.watch.seen,
            tick - reader.newest >= self.watch.quiet or self.watch.block[Block.LOST],
        )

    def check_reading(
        self, tick: int, reading: Reading[AnyMessage], check_messages: int, check_silence: int
    ) -> Reading[AnyMessage]:
        """Run the checks that are requested for a read, and return the reading for the level.

        Args:
            tick: Release tick of the reading cycle.
            reading: The reading to check.
            check_messages: Not 0 if there are messages to check.
            check_silence: Not 0 if the writer's silence must be checked.

        Returns:
            The given reading, with `is_lost` set if the writer is lost or silent for too long.
        """
        if check_messages:
            self.watch.check_messages(tick)
        if self._has_trouble:
            self._report_bad_read(tick)
        if check_silence and self.watch.is_lost(tick):
            return reading._replace(is_lost=True)
        return reading

    def is_writer_lost(self, tick: int) -> bool:
        """Check whether the writer has been found lost, without reading the mailbox."""
        return self.watch.is_writer_lost(tick)


class WatchedQueue(MailboxWatcher):
    """Reader of a queue, which takes as many messages as the level has room for.

    A queue is written on demand, so the silence of its writer is not checked. The writer is lost
    only if it was found dead or hanging.
    """

    reader: QueueReader

    def __init__(
        self,
        segment: Segment,
        reader: QueueReader,
        alarms: AlarmWriter,
        task: ReadingTask,
        count_room: Callable[[], int],
    ) -> None:
        super().__init__(segment, reader, alarms, task)
        self._messages = QueueWatch(segment, reader, self._episodes)
        self._room = count_room
        self._writer = segment.get_block(reader.spec.writer)

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Take as many messages visible at `tick` as the level has room for.

        Returns:
            The newest message taken, its verdict, and whether the writer is lost. Other messages
                taken are in `earlier`.
        """
        reader = self.reader
        reading = reader.take_messages(tick, self._room(), self._task.now())
        if self._has_trouble or reader.taken != self._messages.seen:
            self._messages.check_messages(tick)
        if self._has_trouble:
            self._report_bad_read(tick)
        return reading._replace(is_lost=True) if self.is_writer_lost(tick) else reading

    def is_writer_lost(self, tick: int) -> bool:
        """Check whether the writer has been found lost, without reading the mailbox."""
        # A loss takes effect one tick after it was found. In the same tick, the result would depend
        # on which process is faster.
        return 0 < self._writer[Block.LOST] <= tick


class GridReader:
    """Reads a mailbox only at the ticks of a grid, and repeats the last reading in between.

    If the cycle in which a read is due is skipped, the read is omitted, not postponed. A restarted
    task therefore reads at the same ticks as before.
    """

    def __init__(self, watched: MailboxWatcher, grid: TickGrid) -> None:
        self.reader = watched.reader
        self._watched, self._every, self._phase = watched, *grid
        self._was_lost = False

    def read(self, tick: int) -> Reading[AnyMessage]:
        """Read the mailbox if a read is due at `tick`, otherwise repeat the last reading."""
        if (tick - self._phase) % self._every == 0:
            reading = self._watched.read(tick)
            self._was_lost = reading.is_lost
            return reading
        is_lost = self._was_lost or self._watched.is_writer_lost(tick)
        reading = self.reader.get_reading(False)
        return reading._replace(is_lost=True) if is_lost else reading
