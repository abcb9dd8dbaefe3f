"""Bounds of detection: the ticks within which a fault must be found, counted from the tick at which it first acted.

A bound is a sum of terms. Each term has its text and computes its ticks, so that help, judge and tests have one source.
A cycle is that of the task concerned; a planner's is its time slice. A message is delivered when it is visible, a delay
after its release, and its reader reads next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import ceil

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.protocols import LOCK_WAIT_S

RACK_NS = 5_000_000
"""The Rack knows of a death within this time: the kernel reports it by a pidfd."""
MEMORY_NS = 45_000_000
"""Real time that the kernel may take, before that, to free the memory of a killed process: up to half a millisecond a
megabyte on a busy machine, and a planner with its libraries has 80."""


def cycle_ticks(layout: Layout, board: str) -> int:
    """Return the cycle of a task, in ticks: a planner's is its time slice, the clock's is one tick."""
    if board == CLOCK:
        return 1
    task = layout.task(board)
    return task.every * task.within_cycles


def last_read(mailboxes: tuple[str, ...], layout: Layout) -> int:
    """Return the ticks from the last message in any of these mailboxes until its slowest reader has read it."""
    boxes = [layout.mailbox(name) for name in mailboxes]
    return max((box.delay + cycle_ticks(layout, reader) for box in boxes for reader in box.readers), default=0)


@dataclass(frozen=True)
class BoundCase:
    """One fault, as its bound depends on it. `reader` is the task that finds it; None: whichever finds it first."""

    layout: Layout
    injection: Injection
    parameters: Mapping[str, float]
    reader: str | None = None

    @cached_property
    def board(self) -> str:
        """The task that the fault strikes; "clock" for the clock."""
        return CLOCK if self.injection.task < 0 else self.layout.tasks[self.injection.task].name

    @cached_property
    def mailboxes(self) -> tuple[MailboxSpec, ...]:
        """The mailboxes concerned that the reader reads, or that anybody reads."""
        at, reader = self.injection.mailbox, self.reader
        chosen = self.layout.mailboxes if at < 0 else self.layout.mailboxes[at : at + 1]
        return tuple(m for m in chosen if m.writer == self.board and (reader in m.readers if reader else m.readers))

    @property
    def is_planner(self) -> bool:
        """Whether it strikes a planner, whose messages have no period."""
        return self.board != CLOCK and self.layout.task(self.board).role == "planner"

    @property
    def cycle(self) -> int:
        """The task's cycle, in ticks."""
        return cycle_ticks(self.layout, self.board)

    @property
    def period(self) -> int:
        """Ticks from one release of the task to the next: a planner's are within its time slice."""
        return 1 if self.board == CLOCK else self.layout.task(self.board).every

    @property
    def write(self) -> int:
        """Ticks from one message to the next, of the slowest mailbox."""
        return max(mailbox.every for mailbox in self.mailboxes)

    @property
    def delivery(self) -> int:
        """Ticks from a release of the writer until what it wrote has been read."""
        return max(mailbox.delay for mailbox in self.mailboxes) + self.read

    @property
    def read(self) -> int:
        """Longest time from one read to the next: of the reader, or of the fastest reader of each mailbox."""
        if self.reader:
            return cycle_ticks(self.layout, self.reader)
        fastest = (min(cycle_ticks(self.layout, reader) for reader in m.readers) for m in self.mailboxes)
        return max(fastest, default=0)


@dataclass(frozen=True)
class Bound:
    """A bound of detection: as text, and in ticks. `ticks` returns None where there is no bound."""

    text: str
    ticks: Callable[[BoundCase], int | None]

    def __str__(self) -> str:
        return self.text

    def __add__(self, other: Bound) -> Bound:
        def ticks(case: BoundCase) -> int | None:
            terms = self.ticks(case), other.ticks(case)
            return None if None in terms else sum(term for term in terms if term is not None)

        return Bound(f"{self.text} + {other.text}", ticks)


def cycles(count: int) -> Bound:
    """Return so many cycles of the task; none is the cycle in which it strikes."""
    return Bound(_counted(count, "cycle") if count else "the same cycle", lambda case: count * case.cycle)


def clock_ticks(count: int) -> Bound:
    """Return so many ticks."""
    return Bound(_counted(count, "tick"), lambda case: count)


def writes(count: int) -> Bound:
    """Return so many periods of the mailbox's writer."""
    return Bound(_counted(count, "write"), lambda case: count * case.write)


def missing_writes(count: int) -> Bound:
    """Return so many periods in which no message comes; a planner's messages have no period."""
    return Bound(_counted(count, "write"), lambda case: None if case.is_planner else count * case.write)


def delayed(parameter: str) -> Bound:
    """Return as many periods of the mailbox's writer as a parameter says."""
    return Bound("the delay", lambda case: int(case.parameters[parameter]) * case.write)


def skipped(parameter: str) -> Bound:
    """Return as many ticks as a parameter says: seen at the first tick that is not skipped."""
    return Bound("the next tick", lambda case: int(case.parameters[parameter]))


def by_rack_or(count: int) -> Bound:
    """Return the bound of a death: at the Rack, or at a reader, whose message is then so many cycles old."""

    def ticks(case: BoundCase) -> int:
        return ceil(RACK_NS / case.layout.clock_ns) if case.reader is None else count * case.cycle + case.read

    return Bound(f"{RACK_NS * 1e-6:g} ms by the Rack; {count} cycles + 1 read by a reader", ticks)


READ = Bound("1 read", lambda case: case.read)
DELIVERY = Bound("1 delivery", lambda case: case.delivery)
SLICE = Bound("1 time slice", lambda case: case.cycle)
RELEASE = Bound("1 cycle", lambda case: case.period)
LOCK_WAIT = Bound("the lock's time-out", lambda case: ceil(LOCK_WAIT_S * 1e9 / case.layout.clock_ns))
BY_SIZE = Bound("depends on its size", lambda case: None)
NOT_ARMED = Bound("the rack does not arm", lambda case: None)


def _counted(count: int, unit: str) -> str:
    return f"{count} {unit}{'' if count == 1 else 's'}"
