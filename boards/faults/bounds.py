"""Detection bounds: numbers of ticks within which a fault must be detected.

A bound is counted from the tick at which the fault first shows. Most faults show as soon as they
act. A fault of the arm may at first have a smaller effect than friction, a contact or a slow joint.
No detector could tell such an arm from a working one, so the bound starts later.

A bound is a sum of terms. Each term has a text and computes its ticks; help, reports and tests
all use the same terms. A cycle is a cycle of the affected task; for a planner it is the time slice.
A message is delivered at its reader's first read after it becomes visible.
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
"""Time in ns within which the kernel tells the Rack of a process's death, by pidfd."""
MEMORY_NS = 45_000_000
"""Real time in ns that the kernel may need to free the memory of a killed process.

Up to 0.5 ms per megabyte were seen on a busy machine, and a planner with its libraries has 80 MB.
"""


def cycle_ticks(layout: Layout, board: str) -> int:
    """Return the cycle of a task in ticks: for a planner its time slice, for the clock 1."""
    if board == CLOCK:
        return 1
    return layout.find_task(board).slice


def compute_last_read_ticks(mailboxes: tuple[str, ...], layout: Layout) -> int:
    """Return the longest time in ticks from a writer's release until all readers have the message.

    The result is the maximum over the mailboxes, or 0 if no task reads them.
    """
    return max(
        (
            box.delay + compute_read_interval(layout, box, reader)
            for box in map(layout.find_mailbox, mailboxes)
            for reader in box.readers
        ),
        default=0,
    )


def list_affected_mailboxes(layout: Layout, index: int, board: str) -> tuple[MailboxSpec, ...]:
    """Return the mailboxes that a fault of a task affects.

    Args:
        layout: Layout of the rack.
        index: Index of the mailbox. -1 means all mailboxes that the task writes.
        board: Name of the task. Mailboxes that the task does not write are left out.
    """
    chosen = layout.mailboxes if index < 0 else layout.mailboxes[index : index + 1]
    writer = layout.find_first_copy(board)
    return tuple(mailbox for mailbox in chosen if mailbox.writer == writer)


def compute_read_interval(layout: Layout, mailbox: MailboxSpec, reader: str) -> int:
    """Return the longest interval between a task's reads of a mailbox.

    Args:
        layout: Layout of the rack.
        mailbox: The mailbox.
        reader: Name of the reading task.

    Returns:
        The interval in ticks.
    """
    return max(cycle_ticks(layout, reader), layout.find_read_grid(mailbox, reader).every)


@dataclass(frozen=True)
class BoundCase:
    """Facts about a fault that determine its bound.

    Attributes:
        layout: Layout of the rack.
        injection: The fault.
        parameters: Values of the fault's parameters, by name.
        reader: Task that detects the fault. None for the bound of whichever task detects it first.
    """

    layout: Layout
    injection: Injection
    parameters: Mapping[str, float]
    reader: str | None = None

    @cached_property
    def board(self) -> str:
        """Name of the affected task, or "clock"."""
        return CLOCK if self.injection.task < 0 else self.layout.processes[self.injection.task].name

    @cached_property
    def mailboxes(self) -> tuple[MailboxSpec, ...]:
        """Affected mailboxes that `reader` reads or, if it is None, that any task reads."""
        struck = list_affected_mailboxes(self.layout, self.injection.mailbox, self.board)
        reader = self.reader
        return tuple(box for box in struck if (reader in box.readers if reader else box.readers))

    @property
    def role(self) -> str:
        """Role of the affected task, or "clock"."""
        return CLOCK if self.board == CLOCK else self.layout.find_task(self.board).role

    @property
    def cycle_ticks(self) -> int:
        """Cycle of the affected task in ticks."""
        return cycle_ticks(self.layout, self.board)

    @property
    def write_ticks(self) -> int:
        """Longest writing period in ticks among the affected mailboxes."""
        return max(mailbox.every for mailbox in self.mailboxes)

    @property
    def read_ticks(self) -> int:
        """Longest interval in ticks between reads of an affected mailbox.

        The reads are those of `reader` or, if it is None, those of each mailbox's fastest reader.
        """
        read_interval = partial(compute_read_interval, self.layout)
        if self.reader:
            return max(
                (read_interval(m, self.reader) for m in self.mailboxes),
                default=cycle_ticks(self.layout, self.reader),
            )
        return max(
            (min(read_interval(m, reader) for reader in m.readers) for m in self.mailboxes),
            default=0,
        )


@dataclass(frozen=True)
class Bound:
    """A detection bound.

    Attributes:
        text: The bound in words.
        ticks: Computes the bound in ticks. Returns None if there is no bound, or if this process
            knows only the text.
    """

    text: str
    ticks: Callable[[BoundCase], int | None] = lambda case: None

    def __str__(self) -> str:
        return self.text

    def __add__(self, other: Bound) -> Bound:
        def add_terms(case: BoundCase) -> int | None:
            """Return the sum of both bounds in ticks, or None if one of them is None."""
            first, second = self.ticks(case), other.ticks(case)
            return None if first is None or second is None else first + second

        return Bound(f"{self.text} + {other.text}", add_terms)


def format_count(number: float, noun: str) -> str:
    """Format a number with its noun, such as "1 tick" or "3 ticks"."""
    text = f"{number:.0f}" if abs(number) < float("inf") else str(number)
    return f"1 {noun}" if text == "1" else f"{text} {noun}s"


def cycle_bound(count: int) -> Bound:
    """Return a bound of `count` cycles of the task. 0 stands for the cycle in which the fault acts.

    A fault of a host board has no such bound.
    """
    return Bound(
        format_count(count, "cycle") if count else "the same cycle",
        lambda case: None if case.role == "host" else count * case.cycle_ticks,
    )


def cycle_and_time_bound(count: int, time_ns: int) -> Bound:
    """Return a bound of `count` cycles of the task, but at least `time_ns`.

    The time is needed because a controller's gains, not its cycle, determine how fast it reacts.
    """
    return Bound(
        f"{format_count(count, 'cycle')}, at least {time_ns * 1e-6:g} ms",
        lambda case: max(count * case.cycle_ticks, ceil(time_ns / case.layout.clock_ns)),
    )


def tick_bound(count: int) -> Bound:
    """Return a bound of `count` ticks."""
    return Bound(format_count(count, "tick"), lambda case: count)


def write_bound(count: int) -> Bound:
    """Return a bound of `count` writing periods of the slowest affected mailbox."""
    return Bound(format_count(count, "write"), lambda case: count * case.write_ticks)


READ = Bound("1 read", lambda case: case.read_ticks)
DELIVERY = Bound(
    "1 delivery", lambda case: max(mailbox.delay for mailbox in case.mailboxes) + case.read_ticks
)
"""Time from the release of the writer until a reader has read the message."""
MISSING_WRITES = 2
"""Number of writing periods without a message after which a mailbox is stale."""
MUTE = Bound(
    format_count(MISSING_WRITES, "write"),
    lambda case: None if case.role == "planner" else MISSING_WRITES * case.write_ticks,
)
"""Time without messages after which a mailbox is reported as mute.

None for a planner, which does not write periodically.
"""
DELAY = Bound("the delay", lambda case: int(case.parameters["by"]) * case.write_ticks)
SKIP = Bound(
    "the next cycle of the fastest boards",
    lambda case: max(
        int(case.parameters["ticks"]), min(task.every for task in case.layout.tasks) - 1
    ),
)
"""Time until skipped releases are noticed, in the first tick that is not skipped."""
DEATH_CYCLES = 4
DEATH = Bound(
    f"{RACK_NS * 1e-6:g} ms (Rack), {DEATH_CYCLES} cycles + 1 read (reader)",
    lambda case: (
        ceil(RACK_NS / case.layout.clock_ns)
        if case.reader is None
        else DEATH_CYCLES * case.cycle_ticks + case.read_ticks
    ),
)
"""Time until the Rack notices a death, or a reader notices that the newest message is too old."""
SLICE = Bound("1 time slice", lambda case: case.cycle_ticks)
RELEASE = Bound("1 cycle", lambda case: case.layout.find_task(case.board).every)
"""Interval between two releases of the task. A planner has several in its time slice."""
LOCK_WAIT = Bound(
    "the lock's time-out", lambda case: ceil(LOCK_WAIT_S * 1e9 / case.layout.clock_ns)
)
BY_SIZE = Bound("depends on size")
NOT_ARMED = Bound("the launch fails")
