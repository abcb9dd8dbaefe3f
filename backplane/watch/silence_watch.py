"""Checks on a silent mailbox, whose writer is lost, mute or only late.

Executors write in every cycle, so the age of their messages has a limit. Plans have none. Silence
alone is a reason to hold (`is_lost`) but does not prove a fault. For an alarm the writer must be
dead or stopped, or must have finished cycles without a message. A mailbox that is written on demand
has a limit for the age of its information. Its writer reports why no message comes, and can declare
the mailbox void or keep it valid.
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
"""Age, in cycles of the writer, from which silence is investigated. An age of two is normal."""
STALE_CYCLES = 4


class ReadingTask:
    """The reading task, as its silence watches see it.

    After a pause of this task or of the clock, all messages are old although no writer is silent.

    Attributes:
        since: Tick since which the task has read without a pause.
        troubles: Number of reads that failed or found a bad message.
        now: Function that returns the clock's tick, or None if no read is ever late.
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
        """Record a read at `tick`, and detect pauses from the distance to the last read."""
        step = tick - self._last
        if step != self._step:
            if step > self._step:
                self.since = tick
            elif self._last != LONG_AGO:
                self._step = step
        self._last = tick


class SilenceWatch(MessageWatch):
    """Judges the messages and the silence of one mailbox for one reader.

    Call `is_lost` once the newest message is `quiet` ticks old.
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
        self._block = segment.get_block(spec.writer)
        self._reported: dict[Alarm, int] = {}

    def is_lost(self, tick: int) -> bool:
        """Check whether the writer is lost or has been silent for too long.

        An alarm is raised if the cause is proven.
        """
        if max_age := self._reader.spec.max_age:
            box = self._slots.box
            is_old = tick - self._reader.basis > max_age and not is_switched_on(box[Box.KEPT], tick)
            return is_old or is_switched_on(box[Box.VOID], tick) or self.is_writer_lost(tick)
        newest = self._reader.newest
        age = tick - newest
        if age >= self.quiet:
            pid = get_pid(self._slots.box[Box.CLAIMANT])
            # The loss may already be marked, and a new process may exist that has not cycled yet.
            if age >= self._stale_after and (
                self._block[Block.LOST] or read_state(pid) in ENDED_STATES + STOPPED_STATES
            ):
                self._report_silence(Alarm.STALE, tick, age)
            elif self._is_mute(tick):
                self._report_silence(Alarm.MUTE, tick, age)
            if tick - max(newest, self._task.since) >= self._lost_after:
                return True
        return self.is_writer_lost(tick)

    def is_writer_lost(self, tick: int) -> bool:
        """Check whether the writer is lost, however old its messages are."""
        # A loss counts from the next tick on. Within its tick the answer would depend on which
        # process is faster.
        return self._reader.newest != NO_MESSAGE_TICK and 0 < self._block[Block.LOST] <= tick

    def _is_mute(self, tick: int) -> bool:
        """Check whether the writer has finished a writing release without its message."""
        accesses = self._reader.accesses
        if any(
            self._episodes.is_open(code, accesses, tick)
            for code in (Alarm.HELD_BACK, Alarm.DISORDER)
        ):
            # The writer sends messages, but they come late.
            return False
        # The order matters, because a writer publishes before it reports the cycle as finished.
        finished = self._cycles.finished_tick
        slots = self._slots
        head = slots.box[0]
        # A serial without a message counts as written: the message was lost, not suppressed.
        spec = self._reader.spec
        due = finished - (finished + spec.ahead - spec.phase) % spec.every
        # The writer may not have run that release: it was dead, late, or not released by the clock.
        if self._cycles.find_end_ns(due) is None:
            return False
        return slots.copy_slot(head) and slots.serial == head and slots.tick < due

    def _report_silence(self, code: Alarm, tick: int, age: int) -> None:
        """Raise the alarm once per last good message. The next good message ends the episode."""
        serial = self._reader.serial
        if self._reported.get(code) != serial:
            self._reported[code] = serial
            self._episodes.raise_alarm(code, tick, age, tick - age + self._reader.spec.every)
