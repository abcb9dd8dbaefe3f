"""Table of the faults injected into a rack, in the system controller's shared-memory window.

Any process may add an entry. Only the clock, at the beginning of a tick, decides which faults begin
and end. All tasks of a tick therefore see the same faults, and a lockstep run repeats with the same
faults. The table holds numbers, and `boards` knows the meaning of kinds and parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from time import monotonic_ns

from rack.backplane.address_map import FAULT_ENTRIES, FAULT_ENTRY_SIZE
from rack.backplane.byte_lock import hold_lock
from rack.backplane.errors import FaultTableError
from rack.backplane.segment import Segment
from rack.backplane.words import System, Word

FAULT_WORDS = 16
PARAMETERS = 8
"""Number of parameters of one fault. They are stored as float64 after the words of its entry."""
NEVER = 1 << 62
"""Value of `until` for a fault that lasts until the end of the run."""


class Stage(IntEnum):
    """Values of `FaultEntry.stage`."""

    FREE = 0
    WAITING = 1  # for its tick, or its condition
    ACTIVE = 2
    OVER = 3


@dataclass(frozen=True)
class Injection:
    """Description of one fault before it is entered into the table.

    `FaultEntry` describes the fields. `when` is a condition: mailbox index, field index, and the
    value that the field must have for the fault to begin.
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
    """Entry of the fault table. `words` and `parameters` are views of shared memory.

    The process that injects the fault fills the entry. After that, the clock writes `stage`, `tick`
    and `until`, and the process in which the fault acts writes `struck_tick` and the words after
    it.
    """

    stage = Word(0)  # Stage
    kind = Word(1)  # number of the kind, from its name
    task = Word(2)  # index among the layout's tasks, -1 for the clock
    # Index among the layout's mailboxes, -1 for every mailbox that the task writes, or for none.
    mailbox = Word(3)
    # First tick of the fault, -1 for as soon as possible or when its condition holds.
    tick = Word(4)
    until = Word(5)  # first tick after the fault, known once it has begun
    # Duration, 0 for until the end of the run, or once, depending on the kind.
    ticks = Word(6)
    phase = Word(7)  # fraction of its first tick after which it acts, in 1/1000
    seed = Word(8)
    when_box = Word(9)  # condition: index of a mailbox, -1 for none
    when_field = Word(10)  # condition: index of a field of the mailbox
    when_value = Word(11)  # condition: number that the field must equal
    struck_tick = Word(12)  # tick of its first action, -1 before
    struck_ns = Word(13)  # time of that action on CLOCK_MONOTONIC
    count = Word(14)  # number of actions that a detector is required to notice
    hidden = Word(15)  # ticks from `struck_tick` to the first action that is counted

    def __init__(self, segment: Segment, index: int) -> None:
        address = segment.map.faults + index * FAULT_ENTRY_SIZE
        self.index = index
        self.words = segment.words[address // 8 : (address + FAULT_ENTRY_SIZE) // 8]
        self.parameters = segment.get_bytes(address + 8 * FAULT_WORDS, 8 * PARAMETERS).cast("d")

    def record_action(self, tick: int, must_be_found: bool = True) -> None:
        """Record one action of the fault, such as the damage of one message.

        Args:
            tick: Tick of the action. The first action also sets `struck_tick` and `struck_ns`.
            must_be_found: True if a detector is required to notice this action. Only such actions
                increase `count`.
        """
        if self.struck_tick < 0:
            self.struck_ns = monotonic_ns()
            self.struck_tick = tick
        if must_be_found and not self.count:
            self.hidden = tick - self.struck_tick
        self.count += must_be_found


class FaultTable:
    """Fault table of one rack. `entries` contains all entries, including free ones."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self.entries = [FaultEntry(segment, index) for index in range(FAULT_ENTRIES)]

    @property
    def generation(self) -> int:
        """Counter that the clock increases whenever a fault begins or ends.

        Tasks read the table only when this counter has changed.
        """
        return self._words[System.FAULTS]

    def add_fault(self, injection: Injection) -> FaultEntry:
        """Enter a fault into the table and return its entry.

        The clock begins the fault once its tick is reached and its condition is true.

        Raises:
            FaultTableError: The table is full.
        """
        with hold_lock(self._segment.fd, self._segment.map.faults):
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
            # Store the stage last, because the clock may begin the fault as soon as it is stored.
            entry.stage = Stage.WAITING
            self._words[System.INJECTED] += 1
        return entry

    def advance_waiting(self, ticks: int) -> None:
        """Move the ticks of all waiting faults forward by `ticks`, while the rack is held."""
        for entry in self.list_entries((Stage.WAITING,)):
            entry.tick -= ticks
        # The clock reads the table again if this number has changed.
        self._words[System.INJECTED] += 1

    def disarm_fault(self, entry: FaultEntry) -> None:
        """Change a waiting fault so that it never begins.

        Call `free_entry` after the next tick, when the clock is certain to have read the change.
        """
        # Set the tick first: if the clock saw a fault without a condition and with a tick in the
        # past, it would begin the fault at once.
        entry.tick = NEVER
        entry.when_box = -1

    def free_entry(self, entry: FaultEntry) -> bool:
        """Free the entry of a disarmed fault.

        Returns:
            False if the fault had already begun. In that case the entry is not changed.
        """
        if entry.stage != Stage.WAITING:
            return False
        entry.stage = Stage.FREE
        return True

    def list_entries(self, stages: Sequence[Stage]) -> list[FaultEntry]:
        """Return the entries in one of the given stages."""
        return [e for e in self.entries if e.stage in stages]
