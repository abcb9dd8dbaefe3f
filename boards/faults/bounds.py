"""Bounds of detection: how many ticks after it first acted a fault must have been found, at the latest.

A bound is made of cycles of the task concerned, a planner's being its time slice, and of what a reader adds: a message
is seen only once it is visible, `delay` ticks behind its release, and only when its reader reads next.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.protocols import LOCK_WAIT_S
from rack.boards.faults.kinds import Kind

RACK_NS = 5_000_000
"""Within this time the Rack knows of a death: the kernel tells it by a pidfd."""
MEMORY_NS = 45_000_000
"""Real time that the kernel may take, before that, to give back the memory of a process that was killed: up to half a
millisecond a megabyte on a busy machine, and a planner with its libraries has 80."""


def cycle_ticks(layout: Layout, board: str) -> int:
    """Return the cycle of a task, in ticks: a planner's is its time slice, the clock's is one tick."""
    if board == CLOCK:
        return 1
    task = layout.task(board)
    return task.every * task.within_cycles


@dataclass(frozen=True)
class _Case:
    """One fault as its bound depends on it, times in ticks.

    `cycle` and `period` are of the task concerned: its time slice and the distance of its releases. `read`: the longest
    time from one read of the detector to its next.
    """

    layout: Layout
    cycle: int
    period: int
    parameter: float
    mailboxes: tuple[MailboxSpec, ...]
    read: int
    at_rack: bool

    @property
    def seen(self) -> int:
        """Ticks from a release of the writer until the detector has read what it wrote."""
        return max(mailbox.delay for mailbox in self.mailboxes) + self.read

    @property
    def every(self) -> int:
        """The writer's period."""
        return max(mailbox.every for mailbox in self.mailboxes)


def _kill(case: _Case) -> int:
    """The Rack hears of it in 5 ms; a neighbour finds its message four cycles old, when it reads next."""
    return ceil(RACK_NS / case.layout.clock_ns) if case.at_rack else 4 * case.cycle + case.read


def _cycles(count: int) -> Callable[[_Case], int]:
    """So many cycles of the task concerned."""
    return lambda case: count * case.cycle


BOUNDS: Mapping[str, Callable[[_Case], int]] = {
    "kill": _kill,
    # Four releases without an answer, and the release at which that is seen.
    "hang": _cycles(4 + 1),
    "hog": _cycles(4 + 1),
    # The next release comes before the end of the cycle.
    "overrun": _cycles(1),
    # The d cycles of its slice, and one more.
    "planner-slow": lambda case: case.cycle + case.period,
    # Age alone would do after two periods, and proves nothing: the writer must also have finished a release since.
    "mute": lambda case: 2 * case.every + case.read,
    # What is missing shows by the message behind it.
    "drop": lambda case: case.every + case.seen,
    "reorder": lambda case: case.every + case.seen,
    "delay": lambda case: int(case.parameter) * case.every + case.seen,
    "corrupt": lambda case: case.seen,
    "babble": lambda case: case.seen,
    "masquerade": lambda case: case.seen,
    "lock-held": lambda case: ceil(LOCK_WAIT_S * 1e9 / case.layout.clock_ns) + case.read,
    "clock-stop": lambda case: 3,
    # It is seen at the first tick that is not left out.
    "clock-skip": lambda case: int(case.parameter),
    "clock-jitter": lambda case: 2,
    "sensor-nan": _cycles(1),
    "sensor-stuck": _cycles(20),
    "sensor-dropout": _cycles(2),
    "actuator-off": _cycles(5),
    # What it gives is like a load that pulls, until it is told more and gives no more. The joint loop tells it more by
    # 0.3 of what it lacks in a cycle (twice its bandwidth, 60 rad/s, times the cycle), and a sound motor gives 0.3 of
    # that at least. Dry friction that turns round may give all that it lacks when it strikes: 1 / (0.3 * 0.3) cycles.
    "actuator-saturated": _cycles(12),
    # At the gate, in the same cycle: they never reach the arm.
    "command-nan": _cycles(0),
    "command-limit": _cycles(0),
}
"""By kind. Not here: what the start finds, and what depends on the size of the fault (sensor-bias, sensor-noise)."""
READ = ("kill", "mute", "drop", "delay", "reorder", "corrupt", "babble", "masquerade", "lock-held")
"""Kinds that a reader of the task's mailboxes finds."""


def bound_ticks(kind: Kind, injection: Injection, layout: Layout, reader: str | None = None) -> int | None:
    """Return the ticks from the tick at which a fault first acted to its detection; None when there is no such bound.

    `reader` is the task that finds it; None: whichever finds it first, for `kill` the Rack. A mailbox that nobody reads
    has no bound, nor have a planner's plans that do not come: they have no period.
    """
    if kind.name not in BOUNDS:
        return None
    board = CLOCK if injection.task < 0 else layout.tasks[injection.task].name
    at_rack = kind.name == "kill" and reader is None
    mailboxes = _mailboxes(injection, layout, board, reader)
    if kind.name in READ and not at_rack and not mailboxes:
        return None
    if kind.name == "mute" and layout.task(board).role == "planner":
        return None
    read = cycle_ticks(layout, reader) if reader else _first_read(mailboxes, layout)
    parameter = injection.parameters[0] if injection.parameters else 0.0
    cycle, period = cycle_ticks(layout, board), 1 if board == CLOCK else layout.task(board).every
    return BOUNDS[kind.name](_Case(layout, cycle, period, parameter, mailboxes, read, at_rack))


def _mailboxes(injection: Injection, layout: Layout, board: str, reader: str | None) -> tuple[MailboxSpec, ...]:
    """Return the mailboxes concerned that the reader reads, or that anybody does."""
    chosen = layout.mailboxes if injection.mailbox < 0 else layout.mailboxes[injection.mailbox : injection.mailbox + 1]
    return tuple(m for m in chosen if m.writer == board and (reader in m.readers if reader else m.readers))


def _first_read(mailboxes: tuple[MailboxSpec, ...], layout: Layout) -> int:
    """Return the cycle of the fastest reader of each mailbox, of the slowest such."""
    return max((min(cycle_ticks(layout, reader) for reader in m.readers) for m in mailboxes), default=0)


def last_read(mailboxes: tuple[str, ...], layout: Layout) -> int:
    """Return the ticks from the last message of these mailboxes to its slowest reader: until then traces are found."""
    boxes = [layout.mailbox(name) for name in mailboxes]
    return max((box.delay + cycle_ticks(layout, reader) for box in boxes for reader in box.readers), default=0)
