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

from rack.backplane.address_map import FAULT_ENTRIES, FAULT_ENTRY_SIZE
from rack.backplane.byte_lock import locked
from rack.backplane.errors import FaultTableError
from rack.backplane.segment import Segment
from rack.backplane.words import System, Word

FAULT_WORDS = 16
PARAMETERS = 8
"""Parameters of one fault, float64, after its words."""
NEVER = 1 << 62
"""`until` of a fault that lasts until the end of the run."""


class Stage(IntEnum):
    """Values of `FaultEntry.stage`."""

    FREE = 0
    WAITING = 1  # for its tick, or its condition
    ACTIVE = 2
    OVER = 3


@dataclass(frozen=True)
class Injection:
    """One fault as an entry holds it: see `FaultEntry`. `when` is (mailbox, field, value): two
    indices and a number.
    """

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
    """One entry of the table: `words` and `parameters` are views of shared memory.

    Once it waits, the clock writes `stage`, `tick` and `until`, its actor the words from
    `struck_tick` on.
    """

    stage = Word(0)  # Stage
    kind = Word(1)  # number of the kind, from its name
    task = Word(2)  # index among the layout's tasks; -1: the clock
    # index among the layout's mailboxes; -1: every one that the task writes, or none
    mailbox = Word(3)
    # first tick of the fault; -1: as soon as possible, or when its condition holds
    tick = Word(4)
    until = Word(5)  # first tick after it; known once it has begun
    ticks = Word(6)  # duration; 0: until the end of the run, or once, depending on the kind
    phase = Word(7)  # part of its first tick after which it strikes, in 1/1000
    seed = Word(8)
    when_box = Word(9)  # condition: index of a mailbox; -1: none
    when_field = Word(10)  # index of a field in it
    when_value = Word(11)  # number that the field must equal
    struck_tick = Word(12)  # tick at which it first changed anything, however little; -1: not yet
    struck_ns = Word(13)  # CLOCK_MONOTONIC at that time
    count = Word(14)  # times it acted so much that it must be found
    hidden = Word(15)  # ticks from `struck_tick` to the first of these times

    def __init__(self, segment: Segment, index: int) -> None:
        address = segment.map.faults + index * FAULT_ENTRY_SIZE
        self.index = index
        self.words = segment.words[address // 8 : (address + FAULT_ENTRY_SIZE) // 8]
        self.parameters = segment.view(address + 8 * FAULT_WORDS, 8 * PARAMETERS).cast("d")

    def acted(self, tick: int, shows: bool = True) -> None:
        """Note one action of the fault, and the time of the first one; count those that show: they
        must be found.
        """
        if self.struck_tick < 0:
            self.struck_ns = monotonic_ns()
            self.struck_tick = tick
        if shows and not self.count:
            self.hidden = tick - self.struck_tick
        self.count += shows


class FaultTable:
    """The table of one rack. `entries` holds all entries, free ones too."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self.entries = [FaultEntry(segment, index) for index in range(FAULT_ENTRIES)]

    @property
    def generation(self) -> int:
        """Rises when a fault begins or ends: a task looks at the table only when this number has
        changed.
        """
        return self._words[System.FAULTS]

    def add(self, injection: Injection) -> FaultEntry:
        """Fill a free entry; its fault begins when the clock finds it due. Raises
        `FaultTableError`.
        """
        with locked(self._segment.fd, self._segment.map.faults):
            entry = next((e for e in self.entries if e.stage == Stage.FREE), None)
            if entry is None:
                raise FaultTableError(
                    f"the fault table is full: {len(self.entries)} faults were injected in this run"
                )
            for name in ("kind", "task", "mailbox", "tick", "ticks", "phase", "seed"):
                setattr(entry, name, getattr(injection, name))
            entry.until = NEVER
            entry.when_box, entry.when_field, entry.when_value = injection.when or (-1, 0, 0)
            entry.struck_tick = -1
            for place, parameter in enumerate(injection.parameters):
                entry.parameters[place] = parameter
            # Last: from here the clock may begin it.
            entry.stage = Stage.WAITING
            self._words[System.INJECTED] += 1
        return entry

    def disarm(self, entry: FaultEntry) -> None:
        """Keep a waiting fault from beginning; `free` may follow after the next tick."""
        # In this order: without a condition and with a tick that has passed, it would begin at
        # once.
        entry.tick = NEVER
        entry.when_box = -1

    def free(self, entry: FaultEntry) -> bool:
        """Free the entry of a disarmed fault; False when the clock has already begun it."""
        if entry.stage != Stage.WAITING:
            return False
        entry.stage = Stage.FREE
        return True

    def staged(self, stages: Sequence[Stage]) -> list[FaultEntry]:
        """Return the entries in one of these stages."""
        return [e for e in self.entries if e.stage in stages]
