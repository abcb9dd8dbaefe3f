"""Checks on a mailbox without new messages, whose writer may be lost, mute or only late.

Executors write in every cycle, so there is a limit to the age of their messages. There is none for
plans. Silence alone is a reason for the reading level to hold (`is_lost`), but does not prove a
fault. An alarm is raised only if the writer is dead or stopped, or is mute: it has finished cycles
without writing its message. For a mailbox that is written on demand, there is a limit to the age of
its information instead. If its messages come from another rack, its head can also state that this
rack counts as lost, or that the last message is valid at any age (see `words.Box`).
"""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.mailbox.interrupt import BoardInbox
from rack.backplane.mailbox.mailbox import NO_MESSAGE_TICK, Reader
from rack.backplane.mailbox.slots import get_pid
from rack.backplane.process import ENDED_STATES, STOPPED_STATES, read_state
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, Episodes
from rack.backplane.watch.message_watch import LONG_AGO, MessageWatch
from rack.backplane.words import Block, Box, is_switched_on

MUTE_CYCLES = 3
"""Age of the newest message, in cycles of its writer, from which the writer may be mute.

An age of two is normal.
"""
STALE_CYCLES = 4
"""Age of the newest message, in cycles of the writer, from which a dead writer is reported."""


class ReadingTask:
    """State of a reading task, shared by its readers and watches.

    After a pause of this task or of the clock, all messages are old although no writer is silent.
    The watches must therefore know when the task has paused.

    Attributes:
        since: Tick since which the task has read without a pause.
        troubles: Number of reads that failed or found a bad message.
        now: Function that returns the current tick, or None if the task is never late.
        inbox: Inbox of the task's board. None if nothing interrupts it.
    """

    def __init__(self, inbox: BoardInbox | None = None) -> None:
        self.inbox = inbox
        self.now: Callable[[], int | None] = lambda: None
        self.since = 0
        self.troubles = 0
        self._last = LONG_AGO
        self._step = NO_MESSAGE_TICK

    def record_read(self, tick: int) -> None:
        """Record a read at `tick`. If more ticks than usual have passed, the task has paused."""
        step = tick - self._last
        if step != self._step:
            if step > self._step:
                self.since = tick
            elif self._last != LONG_AGO:
                self._step = step
        self._last = tick


class SilenceWatch(MessageWatch):
    """Checks the messages of one mailbox and the silence of its writer, for one reader.

    Attributes:
        quiet: Smallest age of the newest message, in ticks, at which `is_lost` must be called.
        block: Control block of the mailbox's writer.
    """

    def __init__(
        self, segment: Segment, reader: Reader, episodes: Episodes, task: ReadingTask
    ) -> None:
        super().__init__(segment, reader, episodes)
        spec = reader.spec
        is_periodic = segment.layout.find_task(spec.writer).role == "executor"
        if spec.max_age:
            self.quiet = 0
        else:
            self.quiet = MUTE_CYCLES * spec.every if is_periodic else NO_MESSAGE_TICK
        self._lost_after = self.quiet + spec.delay
        self._stale_after = STALE_CYCLES * spec.every
        self._task = task
        self.block = self._blocks[0]
        self._reported: dict[Alarm, int] = {}

    def is_lost(self, tick: int) -> bool:
        """Check whether the writer is lost or has been silent for too long.

        If the mailbox is written in every period, an alarm is raised if the writer is dead, stopped
        or mute.
        """
        if max_age := self._reader.spec.max_age:
            box = self._slots.box
            is_old = tick - self._reader.basis > max_age and not is_switched_on(box[Box.KEPT], tick)
            return is_old or is_switched_on(box[Box.VOID], tick) or self.is_writer_lost(tick)
        newest = self._reader.newest
        age = tick - newest
        if age >= self.quiet:
            pid = get_pid(self._slots.box[Box.CLAIMANT])
            # If the writer is already marked as lost, `pid` may be its new process, which is alive
            # but has not written yet.
            if age >= self._stale_after and (
                self._blocks[self._active][Block.LOST]
                or read_state(pid) in ENDED_STATES + STOPPED_STATES
            ):
                self._report_silence(Alarm.STALE, tick, age)
            elif self._is_mute(tick):
                self._report_silence(Alarm.MUTE, tick, age)
            if tick - max(newest, self._task.since) >= self._lost_after:
                return True
        return self.is_writer_lost(tick)

    def is_writer_lost(self, tick: int) -> bool:
        """Check whether the writer has been found dead or hanging.

        A lack of messages alone does not make it lost.
        """
        # A loss takes effect one tick after it was found. In the same tick, the result would depend
        # on which process is faster.
        if not 0 < self.block[Block.LOST] <= tick or self._reader.newest == NO_MESSAGE_TICK:
            return False
        return all(0 < block[Block.LOST] <= tick for block in self._blocks)

    def _is_mute(self, tick: int) -> bool:
        """Check whether the writer has finished a cycle without writing the message due in it."""
        if any(
            self._episodes.is_open(code, self._reader.accesses, tick)
            for code in (Alarm.HELD_BACK, Alarm.DISORDER)
        ):
            # The writer is not mute: it sends messages, but they are late or out of order.
            return False
        # Read the finished tick before the newest serial, because a writer publishes a message
        # before it reports its cycle as finished.
        cycles = self._records[self._active]
        finished = cycles.finished_tick
        slots = self._slots
        head = slots.box[0]
        # If the slot of the newest serial is not filled, the writer is not mute: the message was
        # written and lost.
        spec = self._reader.spec
        due = finished - (finished + spec.due_offset) % spec.every
        # The writer may not have run that cycle, because it was dead, late or not released.
        if cycles.find_end_ns(due) is None:
            return False
        return slots.copy_slot(head) and slots.serial == head and slots.tick < due

    def _report_silence(self, code: Alarm, tick: int, age: int) -> None:
        """Raise an alarm, unless it was already raised since the last good message.

        Args:
            code: Kind of alarm.
            tick: Release tick of the reading cycle.
            age: Age of the last good message in ticks.
        """
        serial = self._reader.serial
        if self._reported.get(code) != serial:
            self._reported[code] = serial
            self._episodes.raise_alarm(code, tick, age, tick - age + self._reader.spec.every)
