"""Watching what does not come through a mailbox: whether its writer is lost, mute, or only late.

Executors write in every cycle, so their messages have an age that is lawful; plans have none. Silence alone is
reason to hold (`is_lost`), and no proof of a fault: for an alarm the writer must be dead or stopped, or must
have finished cycles for which no message came.
"""

from __future__ import annotations

from rack.backplane.alarms import Alarm
from rack.backplane.cycle_record import CycleRecord
from rack.backplane.episodes import Episodes
from rack.backplane.mailbox import NOT_YET, Reader
from rack.backplane.process import GONE, STOPPED, state_of
from rack.backplane.segment import Segment
from rack.backplane.slots import pid_of
from rack.backplane.words import Block, Box

MUTE_CYCLES = 3
"""Age, in cycles of the writer, of which two are lawful, from which silence is looked into."""
STALE_CYCLES = 4
LONG_AGO = -(1 << 62)
_LOST, _CLAIMANT = int(Block.LOST), int(Box.CLAIMANT)


class Witness:
    """What a reading task knows besides its mailboxes: how long it has read without a pause, and who is there."""

    def __init__(self) -> None:
        self.since = 0
        self._last = LONG_AGO
        self._step = NOT_YET
        self._asked_at = -1
        self._gone: dict[int, bool] = {}

    def reads(self, tick: int) -> None:
        """Note a read. Behind a pause, of this task or of the clock, every message is old and nobody silent."""
        step = tick - self._last
        if step != self._step:
            if step > self._step:
                self.since = tick
            elif self._last != LONG_AGO:
                self._step = step
        self._last = tick

    def is_gone(self, pid: int, tick: int) -> bool:
        """Say whether a process is dead or stopped. The kernel is asked once a cycle for each."""
        if tick != self._asked_at:
            self._asked_at = tick
            self._gone.clear()
        if pid not in self._gone:
            self._gone[pid] = state_of(pid) in GONE + STOPPED
        return self._gone[pid]


class SilenceWatch:
    """Judges the silence of one mailbox for one reader.

    `quiet` is the age in ticks from which it must be asked, whoever the writer.
    """

    def __init__(self, segment: Segment, reader: Reader, episodes: Episodes, witness: Witness) -> None:
        spec = reader.spec
        is_periodic = segment.layout.task(spec.writer).role == "executor"
        self.quiet = MUTE_CYCLES * spec.every if is_periodic else NOT_YET
        self._lost_after = self.quiet + spec.delay
        self._stale_after = STALE_CYCLES * spec.every
        self._reader, self._episodes, self._witness = reader, episodes, witness
        self._slots = reader.slots
        self._cycles = CycleRecord(segment, spec.writer)
        self._block = segment.block(spec.writer)
        self._told: dict[Alarm, int] = {}

    def is_lost(self, tick: int) -> bool:
        """Say whether the writer is lost or has been silent for too long; ring when there is proof of why."""
        newest = self._reader.newest
        age = tick - newest
        if age >= self.quiet:
            self._look_into(tick, age)
            if tick - max(newest, self._witness.since) >= self._lost_after:
                return True
        # From the tick after the loss on: within that tick it depends on who is faster.
        return newest != NOT_YET and 0 < self._block[_LOST] <= tick

    def _look_into(self, tick: int, age: int) -> None:
        pid = pid_of(self._slots.box[_CLAIMANT])
        # Whoever finds a loss marks it, and a new process may be there before it cycles.
        if age >= self._stale_after and (self._block[_LOST] or self._witness.is_gone(pid, tick)):
            self._tell(Alarm.STALE, tick, age)
        elif self._is_mute(tick):
            self._tell(Alarm.MUTE, tick, age)

    def _is_mute(self, tick: int) -> bool:
        """Say whether the writer has finished a release, and the newest message is of an earlier one."""
        accesses = self._reader.accesses
        if any(self._episodes.is_open(code, accesses, tick) for code in (Alarm.HELD_BACK, Alarm.DISORDER)):
            # It comes, though later than it should.
            return False
        # In this order: a writer publishes before it says that it has finished.
        finished, slots = self._cycles.finished, self._slots
        head = slots.box[0]
        # A serial without a message was lost on its way, not suppressed.
        return slots.copy(head) and slots.serial == head and slots.tick < finished

    def _tell(self, code: Alarm, tick: int, age: int) -> None:
        """Ring once for one last message: the next good one ends the episode."""
        serial = self._reader.serial
        if self._told.get(code) != serial:
            self._told[code] = serial
            self._episodes.ring(code, tick, age, tick - age + self._reader.spec.every)
