"""Detection bounds: the ticks within which a fault must be detected, counted from the tick at which
it first shows.

Most faults show as soon as they act. One of the arm may act at first by less than friction, a
contact or a creeping joint hides: no detector can tell it from a sound arm, so until then no bound
runs.

A bound is a sum of terms. Each term has a text and computes its ticks: one source for help,
judgement and tests. A cycle is that of the affected task; a planner's is its time slice. A message
is delivered at its reader's first read after it becomes visible.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from math import ceil

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.protocols import LOCK_WAIT_S

RACK_NS = 5_000_000
"""The Rack learns of a process's death within this time, from the kernel, by pidfd."""
MEMORY_NS = 45_000_000
"""Real time that the kernel may first take to free the memory of a killed process: up to 0.5 ms per
megabyte on a busy machine, and a planner with its libraries has 80 MB."""


def cycle_ticks(layout: Layout, board: str) -> int:
    """Return the cycle of a task, in ticks; a planner's is its time slice, the clock's one tick."""
    if board == CLOCK:
        return 1
    return layout.task(board).slice


def last_read(mailboxes: tuple[str, ...], layout: Layout) -> int:
    """Return the ticks from the last message in any of these mailboxes until its slowest reader has
    read it.
    """
    boxes = [layout.mailbox(name) for name in mailboxes]
    return max(
        (box.delay + between_reads(layout, box, reader) for box in boxes for reader in box.readers),
        default=0,
    )


def struck_mailboxes(layout: Layout, at: int, board: str) -> tuple[MailboxSpec, ...]:
    """Return the mailboxes that a fault of a task concerns: that with index `at`; -1: all that it
    writes.
    """
    chosen = layout.mailboxes if at < 0 else layout.mailboxes[at : at + 1]
    return tuple(mailbox for mailbox in chosen if mailbox.writer == board)


def between_reads(layout: Layout, mailbox: MailboxSpec, reader: str) -> int:
    """Return the longest time between a task's reads of a mailbox, in ticks."""
    return max(cycle_ticks(layout, reader), layout.read_grid(mailbox, reader).every)


@dataclass(frozen=True)
class BoundCase:
    """The facts about a fault that decide its bound. `reader` is the task that detects it; None:
    the first to do so.
    """

    layout: Layout
    injection: Injection
    parameters: Mapping[str, float]
    reader: str | None = None

    @cached_property
    def board(self) -> str:
        """The task that the fault strikes; "clock" for the clock."""
        return CLOCK if self.injection.task < 0 else self.layout.processes[self.injection.task].name

    @cached_property
    def mailboxes(self) -> tuple[MailboxSpec, ...]:
        """The affected mailboxes that the reader reads; without a `reader`, those that any task
        reads.
        """
        struck = struck_mailboxes(self.layout, self.injection.mailbox, self.board)
        if self.reader:
            return tuple(mailbox for mailbox in struck if self.reader in mailbox.readers)
        return tuple(mailbox for mailbox in struck if mailbox.readers)

    @property
    def role(self) -> str:
        """Role of the task; "clock" for the clock."""
        return CLOCK if self.board == CLOCK else self.layout.task(self.board).role

    @property
    def cycle(self) -> int:
        """The task's cycle, in ticks."""
        return cycle_ticks(self.layout, self.board)

    @property
    def write(self) -> int:
        """Ticks between messages in the slowest mailbox."""
        return max(mailbox.every for mailbox in self.mailboxes)

    @property
    def read(self) -> int:
        """Longest time between reads, ticks: by the reader, or by the fastest reader of each
        mailbox.
        """
        between = partial(between_reads, self.layout)
        if self.reader:
            return max(
                (between(m, self.reader) for m in self.mailboxes),
                default=cycle_ticks(self.layout, self.reader),
            )
        return max(
            (min(between(m, reader) for reader in m.readers) for m in self.mailboxes), default=0
        )


@dataclass(frozen=True)
class Bound:
    """A detection bound, as text and in ticks. `ticks` returns None if there is no bound, or if
    this process knows only the text.
    """

    text: str
    ticks: Callable[[BoundCase], int | None] = lambda case: None

    def __str__(self) -> str:
        return self.text

    def __add__(self, other: Bound) -> Bound:
        def ticks(case: BoundCase) -> int | None:
            terms = self.ticks(case), other.ticks(case)
            return None if None in terms else sum(term for term in terms if term is not None)

        return Bound(f"{self.text} + {other.text}", ticks)


def counting(number: float, noun: str) -> str:
    """Return a number with its noun, as in "1 tick" or "3 ticks"."""
    text = f"{number:.0f}" if abs(number) < float("inf") else str(number)
    return f"1 {noun}" if text == "1" else f"{text} {noun}s"


def cycles(count: int) -> Bound:
    """Return a bound of `count` cycles of the task; 0: the cycle in which the fault strikes. A host
    board has none.
    """

    def ticks(case: BoundCase) -> int | None:
        return None if case.role == "host" else count * case.cycle

    text = counting(count, "cycle") if count else "the same cycle"
    return Bound(text, ticks)


def cycles_and_time(count: int, time_ns: int) -> Bound:
    """Return a bound of `count` cycles of the task, but at least a time, in which a controller's
    gains take effect.
    """

    def ticks(case: BoundCase) -> int:
        return max(count * case.cycle, ceil(time_ns / case.layout.clock_ns))

    return Bound(f"{counting(count, 'cycle')}, at least {time_ns * 1e-6:g} ms", ticks)


def clock_ticks(count: int) -> Bound:
    """Return a bound of `count` ticks."""
    return Bound(counting(count, "tick"), lambda case: count)


def writes(count: int) -> Bound:
    """Return a bound of `count` periods of the mailbox's writer."""
    return Bound(counting(count, "write"), lambda case: count * case.write)


READ = Bound("1 read", lambda case: case.read)
DELIVERY = Bound(
    "1 delivery", lambda case: max(mailbox.delay for mailbox in case.mailboxes) + case.read
)
"""From the writer's release until its message has been read."""
MISSING_WRITES = 2
"""Periods without a message after which a mailbox is stale."""
MUTE = Bound(
    counting(MISSING_WRITES, "write"),
    lambda case: None if case.role == "planner" else MISSING_WRITES * case.write,
)
"""A planner writes at no fixed period: there is no bound."""
DELAY = Bound("the delay", lambda case: int(case.parameters["by"]) * case.write)
SKIP = Bound(
    "the next cycle of the fastest boards",
    lambda case: max(
        int(case.parameters["ticks"]), min(task.every for task in case.layout.tasks) - 1
    ),
)
"""A release that was skipped comes in the first tick that is not."""
DEATH_CYCLES = 4
DEATH = Bound(
    f"{RACK_NS * 1e-6:g} ms (Rack), {DEATH_CYCLES} cycles + 1 read (reader)",
    lambda case: (
        ceil(RACK_NS / case.layout.clock_ns)
        if case.reader is None
        else DEATH_CYCLES * case.cycle + case.read
    ),
)
"""Seen by the Rack, or by a reader whose message is then so many cycles old."""
SLICE = Bound("1 time slice", lambda case: case.cycle)
RELEASE = Bound("1 cycle", lambda case: case.layout.task(case.board).every)
"""From one release of the task to the next; a planner has several in its time slice."""
LOCK_WAIT = Bound(
    "the lock's time-out", lambda case: ceil(LOCK_WAIT_S * 1e9 / case.layout.clock_ns)
)
BY_SIZE = Bound("depends on size")
NOT_ARMED = Bound("the launch fails")
