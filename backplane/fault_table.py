"""The fault table: the faults injected into a rack, in shared memory, in the system controller's
window.

Any process may add an entry. Only the clock, at the beginning of a tick, decides which faults begin
and end: all tasks of a tick see the same faults, and a run in lockstep repeats with them. The table
holds numbers; `boards` knows the meaning of kinds and parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from time import monotonic_ns

from rack.backplane.address_map import CLOCK, FAULT_ENTRIES, FAULT_ENTRY_SIZE
from rack.backplane.byte_lock import ByteLock
from rack.backplane.checked import as_named
from rack.backplane.errors import FaultTableError
from rack.backplane.segment import Segment
from rack.backplane.words import System

PARAMETERS = 8
"""Parameters of one fault."""
NEVER = 1 << 62
"""`until` of a fault that lasts until the end of the run."""


class Stage(IntEnum):
    """Values of `Entry.STAGE`."""

    FREE = 0
    WAITING = 1  # for its tick, or its condition
    ACTIVE = 2
    OVER = 3


class Entry:
    """Words of an entry. Once it waits, the clock writes STAGE, FROM and UNTIL, its actor the
    rest."""

    STAGE = 0
    KIND = 1  # number of the kind, from its name
    TASK = 2  # index among the layout's tasks; -1: the clock
    MAILBOX = 3  # index among the layout's mailboxes; -1: every one that the task writes, or none
    FROM = 4  # first tick of the fault; -1: as soon as possible, or when its condition holds
    UNTIL = 5  # first tick after it; known once it has begun
    TICKS = 6  # duration; 0: until the end of the run, or once, depending on the kind
    PHASE = 7  # part of its first tick after which it strikes, in 1/1000
    SEED = 8
    WHEN_BOX = 9  # condition: index of a mailbox; -1: none
    WHEN_FIELD = 10  # index of a field in it
    WHEN_VALUE = 11  # number that the field must equal
    STRUCK_TICK = 12  # tick at which it first changed anything, however little; -1: not yet
    STRUCK_NS = 13  # CLOCK_MONOTONIC at that time
    COUNT = 14  # times it acted so much that it must be found
    HIDDEN = 15  # ticks from STRUCK_TICK to the first of these times
    PARAMETER = 16  # eight of them, as bits of float64


@dataclass(frozen=True)
class Injection:
    """One fault as an entry holds it: see `Entry`. `when` is (mailbox, field, value): two indices
    and a number."""

    kind: int
    task: int
    mailbox: int = -1
    tick: int = -1
    ticks: int = 0
    phase: int = 0
    seed: int = 0
    when: tuple[int, int, int] | None = None
    parameters: tuple[float, ...] = ()


class FaultEntry:
    """One entry of the table: `words` and `parameters` are views of shared memory."""

    def __init__(self, segment: Segment, index: int) -> None:
        address = segment.map.faults + index * FAULT_ENTRY_SIZE
        self.index = index
        self.words = segment.words[address // 8 : (address + FAULT_ENTRY_SIZE) // 8]
        first = address + 8 * Entry.PARAMETER
        self.parameters = segment.view(first, 8 * PARAMETERS).cast("d")

    def __getitem__(self, word: int) -> int:
        """Return a word of the entry."""
        return self.words[word]

    @property
    def stage(self) -> Stage:
        """The stage of the fault."""
        return as_named(Stage, self.words[Entry.STAGE])

    def acted(self, tick: int, shows: bool = True) -> None:
        """Note one action of the fault, and the time of the first one; count those that show: they
        must be found."""
        if self.words[Entry.STRUCK_TICK] < 0:
            self.words[Entry.STRUCK_NS] = monotonic_ns()
            self.words[Entry.STRUCK_TICK] = tick
        if shows and not self.words[Entry.COUNT]:
            self.words[Entry.HIDDEN] = tick - self.words[Entry.STRUCK_TICK]
        self.words[Entry.COUNT] += shows


class FaultTable:
    """The table of one rack. `entries` holds all entries, free ones too."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self._tasks = {task.name: index for index, task in enumerate(segment.layout.processes)} | {
            CLOCK: -1
        }
        self.entries = [FaultEntry(segment, index) for index in range(FAULT_ENTRIES)]

    @property
    def generation(self) -> int:
        """Rises when a fault begins or ends: a task looks at the table only when this number has
        changed."""
        return self._words[System.FAULTS]

    def add(self, injection: Injection) -> FaultEntry:
        """Fill a free entry; its fault begins when the clock finds it due. Raises
        `FaultTableError`."""
        lock = ByteLock(self._segment.fd, self._segment.map.faults)
        try:
            # Bounded by the time in which another process fills an entry.
            while not lock.take():
                continue
            entry = next((e for e in self.entries if e.stage == Stage.FREE), None)
            if entry is None:
                raise FaultTableError(
                    f"the fault table is full: {len(self.entries)} faults were injected in this run"
                )
            _fill(entry, injection)
            self._words[System.INJECTED] += 1
        finally:
            lock.close()
        return entry

    def disarm(self, entry: FaultEntry) -> None:
        """Keep a waiting fault from beginning; `free` may follow after the next tick."""
        # In this order: without a condition and with a tick that has passed, it would begin at
        # once.
        entry.words[Entry.FROM] = NEVER
        entry.words[Entry.WHEN_BOX] = -1

    def free(self, entry: FaultEntry) -> bool:
        """Free the entry of a disarmed fault; False when the clock has already begun it."""
        if entry.stage != Stage.WAITING:
            return False
        entry.words[Entry.STAGE] = Stage.FREE
        return True

    def active(self, task: str) -> list[FaultEntry]:
        """Return the active faults of a task; "clock" is the clock."""
        index = self._tasks[task]
        return [
            e
            for e in self.entries
            if e.words[Entry.STAGE] == Stage.ACTIVE and e.words[Entry.TASK] == index
        ]

    def staged(self, stages: Sequence[Stage]) -> list[FaultEntry]:
        """Return the entries in one of these stages."""
        return [e for e in self.entries if e.words[Entry.STAGE] in stages]


def _fill(entry: FaultEntry, injection: Injection) -> None:
    words = entry.words
    when = injection.when or (-1, 0, 0)
    for word, value in (
        (Entry.KIND, injection.kind),
        (Entry.TASK, injection.task),
        (Entry.MAILBOX, injection.mailbox),
        (Entry.FROM, injection.tick),
        (Entry.UNTIL, NEVER),
        (Entry.TICKS, injection.ticks),
        (Entry.PHASE, injection.phase),
        (Entry.SEED, injection.seed),
        (Entry.WHEN_BOX, when[0]),
        (Entry.WHEN_FIELD, when[1]),
        (Entry.WHEN_VALUE, when[2]),
        (Entry.STRUCK_TICK, -1),
    ):
        words[word] = value
    for place, parameter in enumerate(injection.parameters):
        entry.parameters[place] = parameter
    # Last: from here the clock may begin it.
    words[Entry.STAGE] = Stage.WAITING
