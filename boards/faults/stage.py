"""The course of every fault, as the clock's board directs it: waiting, active, over."""

from __future__ import annotations

import time

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.fault_table import NEVER, Entry, FaultEntry, FaultTable, Stage
from rack.backplane.mailbox.mailbox import Reader
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter
from rack.backplane.words import System
from rack.boards.faults.kinds import KINDS
from rack.boards.faults.strikes import Strikes

OPEN = (Stage.WAITING, Stage.ACTIVE)
PHASES = 1000
"""Parts of a tick in which a phase is given."""


class FaultStage:
    """Begins faults and ends them, at ticks, before anything of the tick is released.

    A fault with a phase, in real time, strikes within its tick: behind the releases, at its time.
    """

    def __init__(self, segment: Segment, strikes: Strikes, alarms: AlarmWriter) -> None:
        self._segment, self._words = segment, segment.words
        self._table, self._strikes, self._alarms = FaultTable(segment), strikes, alarms
        self._clock = SystemClock(segment)
        self._observers: dict[int, Reader] = {}
        self._injected = 0
        self._open: list[FaultEntry] = []
        self._phased: list[FaultEntry] = []

    @property
    def is_quiet(self) -> bool:
        """True when no fault waits or is active: there is nothing to do in this tick."""
        return not self._open and self._words[System.INJECTED] == self._injected

    def advance(self, tick: int) -> None:
        """Begin what is due at `tick`, and end what is over."""
        self._injected = self._words[System.INJECTED]
        self._open = self._table.staged(OPEN)
        over = [entry for entry in self._open if entry.stage == Stage.ACTIVE and self._is_over(entry, tick)]
        due = [entry for entry in self._open if entry.stage == Stage.WAITING and self._is_due(entry, tick)]
        if over or due:
            self._strikes.settle()
        for entry in over:
            self._finish(entry, tick)
        for entry in due:
            self._begin(entry, tick)
        for entry in self._open:
            if entry.stage == Stage.ACTIVE:
                self._strikes.during(entry, tick)

    def within(self, tick: int) -> None:
        """Strike what has a phase in `tick`, at its time; to be called behind the releases."""
        for entry in sorted(self._phased, key=lambda e: e[Entry.PHASE]):
            at = self._clock.time_of(tick) + entry[Entry.PHASE] * self._clock.period_ns // PHASES
            time.sleep(max(0, at - time.monotonic_ns()) * 1e-9)
            self._strikes.begin(entry, tick)
        self._phased.clear()

    def _is_over(self, entry: FaultEntry, tick: int) -> bool:
        return entry[Entry.UNTIL] <= tick or self._strikes.is_void(entry)

    def _is_due(self, entry: FaultEntry, tick: int) -> bool:
        """Say whether a fault begins; its condition is read every tick, for only then does it see what is new."""
        if entry[Entry.WHEN_BOX] < 0:
            return entry[Entry.FROM] <= tick
        box = entry[Entry.WHEN_BOX]
        spec = self._segment.layout.mailboxes[box]
        if box not in self._observers:
            self._observers[box] = open_observer(self._segment, spec.name)
        reading = self._observers[box].read(tick)
        field = spec.fields[entry[Entry.WHEN_FIELD]].name
        return reading.is_there and int(getattr(reading.value, field)) == entry[Entry.WHEN_VALUE]

    def _begin(self, entry: FaultEntry, tick: int) -> None:
        words, kind = entry.words, KINDS[entry[Entry.KIND]]
        words[Entry.FROM] = tick
        lasts = entry[Entry.TICKS]
        # A lock is held by the task itself, in its next cycle, whenever that comes.
        is_over_at_once = kind.once and kind.where != "lock"
        words[Entry.UNTIL] = tick + 1 if is_over_at_once else tick + lasts if lasts else NEVER
        words[Entry.STAGE] = Stage.ACTIVE
        self._words[System.FAULTS] += 1
        self._alarms.ring(tick, Alarm.FAULT_BEGINS, entry.index)
        if entry[Entry.PHASE] and not self._clock.is_lockstep:
            self._phased.append(entry)
        else:
            self._strikes.begin(entry, tick)

    def _finish(self, entry: FaultEntry, tick: int) -> None:
        entry.words[Entry.STAGE] = Stage.OVER
        self._words[System.FAULTS] += 1
        self._strikes.end(entry, tick)
        self._alarms.ring(tick, Alarm.FAULT_ENDS, entry.index, entry[Entry.COUNT])
