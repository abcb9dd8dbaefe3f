"""Layout of a backplane: its mailboxes and tasks, as plain data.

The Rack computes the layout from its config. The segment is arranged by it and contains it as text,
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

TICK_PROTOCOLS: tuple[Protocol, ...] = ("time-slice", "queue", "interrupt")
"""Protocols under which messages become visible at ticks fixed in advance."""

Role = Literal["executor", "planner", "host"]
"""Kind of task. A "host" is a host board: it has no rate, and the clock does not release it."""

KIND_PATTERN = re.compile(r"[<>|]?[biufcSUV]\d+")
"""Pattern of numpy type strings that a field may have.

A layout may come from another user's segment. An object type would make numpy interpret a number in
a message as the address of a Python object.
"""

Wake = Literal["signal", "timer", "poll"]
"""Method by which a task waits for its next cycle: see `rack.backplane.clock.wake`."""


class TickGrid(NamedTuple):
    """The ticks `phase`, `phase` + `every`, and so on, with `phase` < `every`."""

    every: int
    phase: int = 0

    def find_tick(self, tick: int) -> int:
        """Return the first tick of the grid at `tick` or later. `tick` must not be negative."""
        return tick + (self.phase - tick) % self.every


@dataclass(frozen=True)
class ExchangeSpec:
    """Rule of a config for how an executor reads a mailbox.

    Attributes:
        task: The executor.
        every: Period of its reads, in ticks.
        phase: Tick of its first read.
        asynchronous: True if it reads the newest message as soon as that is complete, under any
            protocol.
    """

    task: str
    every: int
    phase: int
    asynchronous: bool = False

    @property
    def grid(self) -> TickGrid:
        """Ticks at which the executor reads."""
        return TickGrid(self.every, self.phase)


@dataclass(frozen=True)
class InterruptSpec:
    """Sending and service times of a mailbox's messages under protocol interrupt.

    Times refer to the clock of this rack.

    Attributes:
        sent_ns: Time from the release that writes a message until it is sent.
        service_ns: Time for which an interrupt handler serves a message.
        depth: Maximum number of messages that wait for a handler.
        due: Ticks after the release before which the message must be in memory.
        ahead: Ticks between the writing release and the next multiple of the mailbox's period.
        slots: Slots of the boards that a message interrupts.
    """

    sent_ns: int
    service_ns: int
    depth: int
    due: int
    ahead: int
    slots: tuple[int, ...] = ()


@dataclass(frozen=True)
class FieldSpec:
    """Field of a mailbox's message, with all sizes resolved.

    Attributes:
        name: Name of the field.
        kind: numpy type string.
        shape: Shape of an array, () for a scalar.
        offset: Byte offset in the message.
        unit: Unit as text.
        meaning: Meaning of the value.
        fields: Fields of a group, which is a nested message.
        values: Names in lower case and numbers of an enum.
        length: Least and greatest length of a vector, or magnitude of a number.
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
        if not KIND_PATTERN.fullmatch(self.kind):
            raise ValueError(f"a field cannot have the kind {self.kind}")


@dataclass(frozen=True)
class MailboxSpec:
    """Description of one mailbox. Times are in ticks.

    Attributes:
        name: Name of the mailbox.
        writer: Task that writes it.
        readers: Tasks that read it.
        protocol: When its messages become visible.
        every: Period of the messages. They become visible at multiples of it, counted from
            `phase`.
        delay: Ticks from a release until its message is visible; the least under protocol
            interrupt.
        depth: Number of slots, a power of two.
        message: Name of the message type.
        version: Version of the message type.
        size: Size of a message in bytes.
        fields: Fields of the message.
        rests_on: Mailboxes on whose information its messages depend, without queues. Its writer
            reads all of them.
        capacity: Maximum number of unread messages of a queue. 0 for other protocols.
        phase: First tick at which a message can become visible.
        exchanges: Readers that do not simply read it in every cycle.
        max_age: Age of the information from which readers treat the writer as lost, for a
            mailbox written on demand. 0 for a mailbox written in every period.
        interrupt: How messages are sent under protocol interrupt, otherwise None.
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
        """Ticks from the release of the writing cycle to the next multiple of the period."""
        return self.delay if self.interrupt is None else self.interrupt.ahead

    @property
    def is_by_ticks(self) -> bool:
        """True if ticks alone decide when its messages become visible."""
        return self.protocol in TICK_PROTOCOLS

    @property
    def is_repeatable(self) -> bool:
        """True if ticks alone decide which message each reader gets."""
        return self.is_by_ticks and not any(exchange.asynchronous for exchange in self.exchanges)


@dataclass(frozen=True)
class TaskSpec:
    """A schedulable task: the executor or the planner of a board, or a host board.

    Attributes:
        name: "servo" for an executor, "servo.planner" for its planner.
        board: Name of the board.
        role: Kind of task.
        slot: VME slot of the board.
        core: Processor core to which the task is pinned.
        priority: SCHED_FIFO priority, 0 for ordinary scheduling.
        every: Period in ticks.
        within_cycles: Number of cycles that one plan may take.
        depth: Number of records in its trace ring, a power of two.
        wake: How it waits for its next cycle in real time.
        phase: Tick of its first release.
        is_external: True for a host board that the rack does not start.
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
        """Release ticks of the task."""
        return TickGrid(self.every, self.phase)

    @property
    def slice(self) -> int:
        """Time for one cycle or one plan, in ticks."""
        return self.every * self.within_cycles

    def count_unfinished(self, done: int, tick: int) -> int:
        """Count the releases after `done` that should have been finished by `tick`."""
        return max(0, (tick - self.slice - self.grid.find_tick(done + 1)) // self.every + 1)


@dataclass(frozen=True)
class Layout:
    """Everything on one backplane.

    Attributes:
        rack: Name of the rack.
        clock_ns: Period of the system clock.
        tasks: Tasks that the clock releases.
        mailboxes: All mailboxes.
        hosts: Host boards, which the clock does not release.
    """

    rack: str
    clock_ns: int
    tasks: tuple[TaskSpec, ...]
    mailboxes: tuple[MailboxSpec, ...]
    hosts: tuple[TaskSpec, ...] = ()

    @property
    def processes(self) -> tuple[TaskSpec, ...]:
        """All tasks, followed by the host boards. Each runs as one process."""
        return self.tasks + self.hosts

    @property
    def timed(self) -> tuple[MailboxSpec, ...]:
        """Mailboxes that tasks and the clock write at ticks."""
        hosts = {host.name for host in self.hosts}
        return tuple(mailbox for mailbox in self.mailboxes if mailbox.writer not in hosts)

    def find_pacers(self, host: TaskSpec) -> set[str]:
        """Return the bus adapters that pace a host board's program in lockstep.

        The set is empty for an external host board.
        """
        return {
            task.name
            for task in self.tasks
            for box in self.mailboxes
            if {task.name, host.name} <= {box.writer, *box.readers} and not host.is_external
        }

    def find_mailbox(self, name: str) -> MailboxSpec:
        """Return the mailbox with this name.

        Raises:
            KeyError: There is no such mailbox.
        """
        return {m.name: m for m in self.mailboxes}[name]

    def find_mailbox_index(self, mailbox: str) -> int:
        """Return the index of the mailbox with this name.

        Raises:
            ValueError: There is no such mailbox.
        """
        return [box.name for box in self.mailboxes].index(mailbox)

    def find_task(self, name: str) -> TaskSpec:
        """Return the task or host board with this name.

        Raises:
            KeyError: There is no such task.
        """
        return {t.name: t for t in self.processes}[name]

    def compute_due_ticks(self, task: TaskSpec) -> int:
        """Return the ticks from a release until the task's first message is required."""
        sent = [
            m.interrupt.due
            for m in self.mailboxes
            if m.writer == task.name and m.interrupt is not None
        ]
        return min([task.every, *sent])

    def list_interrupting_mailboxes(self, slot: int) -> list[MailboxSpec]:
        """Return the mailboxes that interrupt the board in a slot.

        They are ordered by the slot of their sender.
        """
        mailboxes = [
            m for m in self.mailboxes if m.interrupt is not None and slot in m.interrupt.slots
        ]
        return sorted(mailboxes, key=lambda mailbox: self.find_task(mailbox.writer).slot)

    def find_interrupt_task(self, slot: int) -> str:
        """Return the task that serves the interrupts of the board in a slot, its first task.

        Raises:
            StopIteration: There is no task in this slot.
        """
        return next(task.name for task in self.tasks if task.slot == slot)

    def find_read_grid(self, mailbox: MailboxSpec, reader: str) -> TickGrid:
        """Return the ticks at which a task reads a mailbox. A planner reads at its releases.

        Raises:
            KeyError: There is no such task.
        """
        exchanged = (e.grid for e in mailbox.exchanges if e.task == reader)
        return max(exchanged, default=self.find_task(reader).grid)


SPARE_SLOTS = 2
"""Slots of a host board's mailbox in addition to the messages that may wait.

One is being written, and one is being copied by the bus adapter.
"""


def compute_depth(span_ticks: int, every: int) -> int:
    """Return the number of slots that hold the messages of `span_ticks` ticks.

    Args:
        span_ticks: Length of the time span.
        every: Period of the writer, in ticks.

    Returns:
        A power of two, at least 4.
    """
    slot_count = max(4, -(-span_ticks // every) + 3)
    return 1 << (slot_count - 1).bit_length()
