"""The layout of a backplane: its mailboxes and tasks, as plain data.

The Rack computes a layout from its config. The segment is laid out from it and carries it as text,
so a tool that attaches by name knows every mailbox and every task without importing the config's
classes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

Sampled = Literal["time-slice", "double-buffer", "lock", "interrupt"]
"""Protocols whose readers sample the newest message."""
PROTOCOLS: tuple[Sampled, ...] = ("time-slice", "double-buffer", "lock", "interrupt")
Protocol = Literal[Sampled, "queue"]

BY_TICKS: tuple[Protocol, ...] = ("time-slice", "queue", "interrupt")
"""Protocols under which messages become visible at ticks fixed in advance."""

Role = Literal["executor", "planner", "host"]
"""A "host" is a board of the host side: it has no rate, and the clock does not release it."""

KIND = re.compile(r"[<>|]?[biufcSUV]\d+")
"""Kinds of fields. A layout may be another user's: numpy would take an object of Python's from the
number in a message."""

Wake = Literal["signal", "timer", "poll"]
"""How a task waits for its next cycle: see `rack.backplane.clock.wake`."""


class TickGrid(NamedTuple):
    """The ticks `phase`, `phase` + `every`, ..., with `phase` < `every`."""

    every: int
    phase: int = 0

    def since(self, tick: int) -> int:
        """Return the first of them at `tick` or later, `tick` not being negative."""
        return tick + (self.phase - tick) % self.every


@dataclass(frozen=True)
class ExchangeSpec:
    """How the executor `task` reads a mailbox, if the config says so: at the ticks `phase`, `phase`
    + `every`, ...

    `asynchronous`: it gets the newest message as soon as that is whole, whatever the protocol.
    """

    task: str
    every: int
    phase: int
    asynchronous: bool = False

    @property
    def grid(self) -> TickGrid:
        """The ticks at which it reads."""
        return TickGrid(self.every, self.phase)


@dataclass(frozen=True)
class InterruptSpec:
    """How the messages of a mailbox travel under protocol interrupt. Its times are of the rack's
    own clock.

    A message is sent `sent_ns` after the release that writes it; it must be there before the tick
    `due` after that release. It interrupts the boards in `slots`; at each a handler serves it for
    `service_ns`, and `depth` messages wait at most. It is written in the cycles released `ahead`
    ticks before the multiples of the mailbox's period.
    """

    sent_ns: int
    service_ns: int
    depth: int
    due: int
    ahead: int
    slots: tuple[int, ...] = ()


@dataclass(frozen=True)
class FieldSpec:
    """One field of a mailbox's message, resolved: numpy type string, shape, byte offset, unit,
    meaning.

    `fields` holds the fields of a group (a nested message), `values` the names (lower case) and
    numbers of an enum, `length` the least and the greatest one of a vector, or magnitude of a
    number.
    """

    name: str
    kind: str
    shape: tuple[int, ...]
    offset: int
    unit: str
    meaning: str
    fields: tuple[FieldSpec, ...] = ()
    values: tuple[tuple[str, int], ...] = ()
    length: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not KIND.fullmatch(self.kind):
            raise ValueError(f"a field of kind {self.kind}")


@dataclass(frozen=True)
class MailboxSpec:
    """One mailbox: its writer and readers, its message, its protocol.

    `every` is the time from message to message and `delay` the time from release to visibility,
    both in ticks; messages become visible at multiples of `every`, counted from tick `phase`.
    `depth` is the number of slots, a power of two. `rests_on` names the mailboxes on whose
    information its messages rest, all read by its writer; queues, in which messages wait, are not
    among them. `capacity`: of a queue, the largest number of unread messages; 0: it is no queue.
    `exchanges` are the readers that do not simply read it in every cycle. `max_age`, ticks: of a
    mailbox written only when there is something new, the age of its information from which readers
    take the writer for lost; 0: it is written in every period. `interrupt`: of protocol interrupt;
    `delay` is then the time to the earliest visibility.
    """

    name: str
    writer: str
    readers: tuple[str, ...]
    protocol: Protocol
    every: int
    delay: int
    depth: int
    message: str
    version: int
    size: int
    fields: tuple[FieldSpec, ...]
    rests_on: tuple[str, ...] = ()
    capacity: int = 0
    phase: int = 0
    exchanges: tuple[ExchangeSpec, ...] = ()
    max_age: int = 0
    interrupt: InterruptSpec | None = None

    @property
    def ahead(self) -> int:
        """How long before a multiple of its period the cycle is released that writes it, ticks."""
        return self.delay if self.interrupt is None else self.interrupt.ahead

    @property
    def is_by_ticks(self) -> bool:
        """Whether its messages become visible by ticks alone."""
        return self.protocol in BY_TICKS

    @property
    def is_repeatable(self) -> bool:
        """Whether what each of its readers gets depends on ticks alone."""
        return self.is_by_ticks and not any(exchange.asynchronous for exchange in self.exchanges)


@dataclass(frozen=True)
class TaskSpec:
    """One schedulable task: the executor of a board or its planner.

    `name` is "servo" for an executor and "servo.planner" for a planner. `every` is the period in
    ticks; releases are the ticks `phase`, `phase` + `every`, ... `within_cycles` is the cycles that
    one plan may take. `priority` is SCHED_FIFO's, 0 for ordinary scheduling. `depth` is the number
    of records in its trace ring, a power of two. `wake`: how it waits for its next cycle in real
    time. `is_external`: a host board that the rack does not start.
    """

    name: str
    board: str
    role: Role
    slot: int
    core: int
    priority: int
    every: int
    within_cycles: int
    depth: int
    wake: Wake = "signal"
    phase: int = 0
    is_external: bool = False

    @property
    def grid(self) -> TickGrid:
        """Its releases."""
        return TickGrid(self.every, self.phase)

    @property
    def slice(self) -> int:
        """Time for one cycle, or one plan, ticks."""
        return self.every * self.within_cycles

    def count_unfinished(self, done: int, tick: int) -> int:
        """Count the releases after `done` that should have been finished by `tick`."""
        return max(0, (tick - self.slice - self.grid.since(done + 1)) // self.every + 1)


@dataclass(frozen=True)
class Layout:
    """Everything on one backplane. `clock_ns` is the period of the system clock.

    `tasks` are those that the clock releases, `hosts` the boards of the host side.
    """

    rack: str
    clock_ns: int
    tasks: tuple[TaskSpec, ...]
    mailboxes: tuple[MailboxSpec, ...]
    hosts: tuple[TaskSpec, ...] = ()

    @property
    def processes(self) -> tuple[TaskSpec, ...]:
        """Everything that runs as a process of its own: tasks, then host boards."""
        return self.tasks + self.hosts

    @property
    def timed(self) -> tuple[MailboxSpec, ...]:
        """The mailboxes that tasks and clock write, at ticks."""
        hosts = {host.name for host in self.hosts}
        return tuple(mailbox for mailbox in self.mailboxes if mailbox.writer not in hosts)

    def pacers(self, host: TaskSpec) -> set[str]:
        """Return the bus adapters in whose cycles a host board's program runs in lockstep: none of
        an external one.
        """
        return {
            task.name
            for task in self.tasks
            for box in self.mailboxes
            if {task.name, host.name} <= {box.writer, *box.readers} and not host.is_external
        }

    def mailbox(self, name: str) -> MailboxSpec:
        """Return the mailbox of that name. Raises `KeyError`."""
        return {m.name: m for m in self.mailboxes}[name]

    def index(self, mailbox: str) -> int:
        """Return the place of the mailbox of that name among all. Raises `ValueError`."""
        return [box.name for box in self.mailboxes].index(mailbox)

    def task(self, name: str) -> TaskSpec:
        """Return the task, or the host board, of that name. Raises `KeyError`."""
        return {t.name: t for t in self.processes}[name]

    def due(self, task: TaskSpec) -> int:
        """Return the ticks from a release of a task until the first of its messages must be
        there.
        """
        sent = [
            m.interrupt.due
            for m in self.mailboxes
            if m.writer == task.name and m.interrupt is not None
        ]
        return min([task.every, *sent])

    def interrupting(self, slot: int) -> list[MailboxSpec]:
        """Return the mailboxes whose messages interrupt the board in a slot, by the slot of their
        sender.
        """
        found = [m for m in self.mailboxes if m.interrupt is not None and slot in m.interrupt.slots]
        return sorted(found, key=lambda mailbox: self.task(mailbox.writer).slot)

    def handler(self, slot: int) -> str:
        """Return the task that serves the interrupts of the board in a slot: its first one. Raises
        `StopIteration`.
        """
        return next(task.name for task in self.tasks if task.slot == slot)

    def read_grid(self, mailbox: MailboxSpec, reader: str) -> TickGrid:
        """Return the ticks at which a task reads a mailbox; a planner's, its releases. Raises
        `KeyError`.
        """
        exchanged = (e.grid for e in mailbox.exchanges if e.task == reader)
        return max(exchanged, default=self.task(reader).grid)


SPARE = 2
"""Slots of a host board's mailbox more than messages may wait: the one being written, and one that
the adapter copies meanwhile."""


def depth_for(span_ticks: int, every: int) -> int:
    """Return the slots, a power of two and at least 4, that keep `span_ticks` ticks of a writer of
    period `every`.
    """
    wanted = max(4, -(-span_ticks // every) + 3)
    return 1 << (wanted - 1).bit_length()
