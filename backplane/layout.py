"""Layout of a backplane: its mailboxes and tasks, as plain data.

The Rack computes the layout from its config. The layout determines how the segment is divided, and
the segment contains it as text, so a tool that attaches by name knows every mailbox and every task
without importing the config's classes.
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

Role = Literal["executor", "planner", "standby", "host"]
"""Kind of task.

"standby" stands for a further copy of an executor. "host" stands for a host board, which has no
rate and is not released.
"""

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
    """Config rule that states at which ticks an executor reads a mailbox.

    Attributes:
        task: Name of the executor.
        every: Period of its reads, in ticks.
        phase: Tick of its first read.
        asynchronous: True if it reads each message as soon as the message is complete, under any
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

    All times are counted by the clock of this rack.

    Attributes:
        sent_ns: Time from the release of the writing cycle until its message is sent, which is its
            worst-case response.
        service_ns: Time that an interrupt handler takes to serve one message.
        depth: Maximum number of messages that wait for a handler.
        due: Number of ticks after the release within which the message must be in memory.
        ahead: Number of ticks from the release of a writing cycle to the end of its period, which
            is a tick of the mailbox's grid. This is the delay that time-slice would have.
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
        values: Members of an enum, each as its name in lower case and its number.
        length: Smallest and largest permitted norm of a vector, or magnitude of a number. None if
            there is no such limit.
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
        protocol: Protocol, which determines when messages become visible.
        every: Period of the messages. With `phase` it defines the mailbox's grid, the ticks at
            which messages normally become visible.
        delay: Ticks from the release of the writing cycle until its message is visible. Under
            protocol interrupt, the smallest number of such ticks.
        depth: Number of slots, a power of two.
        message: Name of the message type.
        version: Version of the message type.
        size: Size of a message in bytes.
        fields: Fields of the message.
        rests_on: Mailboxes from whose content its messages are computed, except queues. Its
            writer reads all of them.
        capacity: Maximum number of unread messages of a queue. 0 for other protocols.
        phase: First tick at which a message can become visible.
        exchanges: Rules of the executors that read it at a different rate or asynchronously.
        max_age: For a mailbox written on demand, age of its information in ticks beyond which
            readers treat the writer as lost. 0 for a mailbox written in every period.
        interrupt: Times of sending and service under protocol interrupt, otherwise None.
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
    def due_offset(self) -> int:
        """Number of ticks that shows which cycles write the mailbox.

        A cycle writes it if the sum of its release tick and this number is a multiple of `every`.
        The message then becomes visible at a tick of the mailbox's grid.
        """
        return (self.delay if self.interrupt is None else self.interrupt.ahead) - self.phase

    @property
    def is_tick_based(self) -> bool:
        """True if the release tick of the writing cycle determines when a message becomes visible.

        Under other protocols, the real time of the write matters too.
        """
        return self.protocol in TICK_PROTOCOLS

    @property
    def is_repeatable(self) -> bool:
        """True if ticks alone determine which message each reader gets at each read."""
        return self.is_tick_based and not any(exchange.asynchronous for exchange in self.exchanges)


@dataclass(frozen=True)
class TaskSpec:
    """A schedulable task: the executor or the planner of a board, or a host board.

    Attributes:
        name: "servo" for an executor, "servo.planner" for its planner, "servo.standby" for its
            standby, "servo.standby2" for a second one.
        board: Name of the board.
        role: Kind of task.
        slot: VME slot of the board.
        core: Processor core to which the task is pinned.
        priority: SCHED_FIFO priority, 0 for ordinary scheduling.
        every: Period in ticks.
        within_cycles: Number of cycles that one plan may take. 1 for an executor.
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
        """Time slice of one cycle of an executor or one plan of a planner, in ticks."""
        return self.every * self.within_cycles

    def count_unfinished(self, done: int, tick: int) -> int:
        """Return the number of releases that should have been finished by `tick` but were not.

        Args:
            done: Newest release that was finished, -1 before the first.
            tick: Current tick.
        """
        return max(0, (tick - self.slice - self.grid.find_tick(done + 1)) // self.every + 1)


@dataclass(frozen=True)
class Layout:
    """Description of everything on one backplane.

    Attributes:
        rack: Name of the rack.
        clock_ns: Length of a tick of the system clock.
        tasks: Tasks that the clock releases.
        mailboxes: All mailboxes.
        hosts: Host boards, which the clock does not release.
    """

    rack: str
    clock_ns: int
    tasks: tuple[TaskSpec, ...]
    mailboxes: tuple[MailboxSpec, ...]
    hosts: tuple[TaskSpec, ...] = ()

    def to_ticks(self, seconds: float) -> int:
        """Convert simulated time in s to ticks."""
        return round(seconds * 1e9 / self.clock_ns)

    @property
    def processes(self) -> tuple[TaskSpec, ...]:
        """All tasks, followed by the host boards. Each runs as one process."""
        return self.tasks + self.hosts

    @property
    def timed(self) -> tuple[MailboxSpec, ...]:
        """All mailboxes except those written by host boards, which may write at any time.

        Also except mailboxes through which the clock is asked to switch to a standby, and which no
        level reads. A rack with standbys thus has the same digest as without them.
        """
        hosts = {host.name for host in self.hosts}
        tasks = {task.name for task in self.tasks}
        return tuple(
            mailbox
            for mailbox in self.mailboxes
            if mailbox.writer not in hosts
            and (
                mailbox.readers
                or mailbox.writer in tasks
                or mailbox.name.partition(".")[0] not in self.replicated_tasks
            )
        )

    @property
    def replicated_tasks(self) -> tuple[str, ...]:
        """Names of the tasks that have standbys."""
        return tuple(dict.fromkeys(t.board for t in self.tasks if t.role == "standby"))

    def list_copies(self, task: str) -> tuple[TaskSpec, ...]:
        """Return a task, followed by its standbys in their order."""
        standbys = (s for s in self.tasks if s.role == "standby" and s.board == task)
        return (self.find_task(task), *standbys)

    def find_first_copy(self, task: str) -> str:
        """Return the name of the task that a standby copies. For other tasks, return their own."""
        return next((s.board for s in self.tasks if (s.name, s.role) == (task, "standby")), task)

    def find_pacers(self, host: TaskSpec) -> set[str]:
        """Return the bus adapters that share a mailbox with a host board.

        In lockstep their cycles determine when the host board's program runs. The set is empty for
        an external host board, which runs at its own speed.
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
        """Return the number of ticks after a release within which a task must write.

        This is its time slice, or less if one of its messages must be sent earlier by interrupt.
        """
        sent = [
            m.interrupt.due
            for m in self.mailboxes
            if m.writer == task.name and m.interrupt is not None
        ]
        return min([task.slice, *sent])

    def list_interrupting_mailboxes(self, slot: int) -> list[MailboxSpec]:
        """Return the mailboxes that interrupt the board in a slot, sorted by writer slot."""
        mailboxes = [
            m for m in self.mailboxes if m.interrupt is not None and slot in m.interrupt.slots
        ]
        return sorted(mailboxes, key=lambda mailbox: self.find_task(mailbox.writer).slot)

    def find_interrupt_task(self, slot: int) -> str:
        """Return the task that serves a board's interrupts: the first task in the board's slot.

        Raises:
            StopIteration: There is no task in this slot.
        """
        return next(task.name for task in self.tasks if task.slot == slot)

    def find_read_grid(self, mailbox: MailboxSpec, reader: str) -> TickGrid:
        """Return the ticks at which a task reads a mailbox.

        These are its releases, unless the mailbox has an exchange rule for the task.

        Raises:
            KeyError: There is no such task.
        """
        exchanged = (e.grid for e in mailbox.exchanges if e.task == reader)
        return max(exchanged, default=self.find_task(reader).grid)


SPARE_SLOTS = 2
"""Number of slots of a host board's mailbox in addition to those for waiting messages.

One is for the message being written, and one for the message that the bus adapter is copying.
"""


def compute_depth(span_ticks: int, every: int) -> int:
    """Return the number of slots that a mailbox needs to hold the messages of a time span.

    Args:
        span_ticks: Length of the time span, in ticks.
        every: Period of the messages, in ticks.

    Returns:
        A power of two, at least 4.
    """
    slot_count = max(4, -(-span_ticks // every) + 3)
    return 1 << (slot_count - 1).bit_length()
