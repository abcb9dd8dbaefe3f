"""Layout of a rack, computed from its wiring: all tasks and mailboxes of its segment."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import (
    SPARE_SLOTS,
    ExchangeSpec,
    FieldSpec,
    InterruptSpec,
    Layout,
    MailboxSpec,
    TaskSpec,
    compute_depth,
)
from rack.backplane.mailbox.queue import QueueTaken, get_position_mailbox
from rack.backplane.message_type import MessageType
from rack.boards.config.connections import TaskPorts, Wiring
from rack.boards.config.protocols import UNREAD
from rack.boards.config.schema import RackConfig, TaskEntry
from rack.boards.config.timing import build_rack_timing

OPERATOR_DEPTH = 128
"""Slots of an operator's mailbox. Few are needed, because commands are rare."""
RETAINED_S = 2.0
"""Simulated time, in s, for which mailboxes and trace rings retain their records.

Real-time boards may keep the recorder from running for 1 s, and it must not lose data in that time.
"""
SUSTAINED = 4
"""Average number of messages per cycle of the writer that a deep queue retains.

A recorder can keep up with this rate. The limit saves memory.
"""
NEVER = 1 << 62
"""A response in ns without a bound. The message is then sent at the end of the cycle."""
WORD_BYTES = 4
"""Bytes of one word in `[protocol.interrupt]`, the width of the 68020's bus."""
NS_PER_US = 1e3
NS_PER_MS = 1e6


def find_core(core: int) -> int:
    """Return the core for a task that requests `core`.

    If that core is not available, its number determines which available core replaces it.
    """
    available = sorted(os.sched_getaffinity(0))
    return core if core in available else available[core % len(available)]


def list_replaced_cores(config: RackConfig) -> list[str]:
    """Return a line for each requested core that is not available, naming its replacement."""
    requested: dict[int, list[str]] = {config.clock.core: [CLOCK]}
    for place in config.list_tasks():
        requested.setdefault(place.core, []).append(place.name)
    available = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    return [
        f"core {core} is not available (available: {available}): core {find_core(core)} runs"
        f" {', '.join(tasks)}"
        for core, tasks in sorted(requested.items())
        if find_core(core) != core
    ]


def build_exchanges(wiring: Wiring, ports: TaskPorts) -> dict[str, ExchangeSpec]:
    """Return, for each port in an executor's `exchange` table, the ticks at which it is read."""
    board = ports.place.board
    every = wiring.periods[board]
    phase = wiring.config.board[board].phase
    return {
        port: ExchangeSpec(
            board, every * entry.every, phase + every * entry.phase, entry.asynchronous
        )
        for port, entry in ports.exchange.items()
    }


class LayoutBuilder:
    """Computes the layout of a wiring. Boards with mistakes are left out.

    Args:
        wiring: The wiring.
        sizes: Sizes that messages use by name, such as the number of joints.
    """

    def __init__(self, wiring: Wiring, sizes: Mapping[str, int]) -> None:
        self._wiring = wiring
        self._config = wiring.config
        self._sizes = sizes
        # Times from a release to the sending of interrupts, by executor. For others it is the
        # budget of a cycle, or one tick without a budget.
        self._sent_ns = {
            name: round(board.budget.send_within_ms * NS_PER_MS)
            for name, board in wiring.config.board.items()
            if board.budget and board.budget.send_within_ms
        }
        self._retained_ticks = round(RETAINED_S * 1e9 / wiring.config.clock_ns)
        self._tasks = {ports.task: self._build_task(ports.place) for ports in wiring.ports.values()}

    def settle_sending(self) -> Layout:
        """Return the layout of a config without mistakes, with the instants of sending interrupts.

        A receiver counts with an instant at which a message is in memory: the worst-case response
        of its writer. Responses include the handlers that preempt a task, and a handler runs when a
        message is sent. The instants are therefore raised, from the budgets on, until each is at
        least the response that follows from all of them, or the end of the cycle. Any such instants
        are kept: as long as all earlier messages were in memory in time, handlers run and cycles
        end as computed.

        A board with `budget.send_within_ms` sends at that time, whether or not its response keeps
        it.
        """
        fixed = {*self._sent_ns}
        # The instants are simulated times, which do not depend on the speed.
        clock = self._config.clock.model_copy(update={"speed": 1.0})
        config = self._config.model_copy(update={"clock": clock})
        while True:
            layout = self.build_layout()
            senders = {
                box.writer: box.interrupt.sent_ns
                for box in layout.mailboxes
                if box.interrupt and box.writer not in fixed
            }
            before_ns = dict(self._sent_ns)
            for task in build_rack_timing(config, layout).responses if senders else ():
                if task.task in senders:
                    self._sent_ns[task.task] = max(senders[task.task], task.response_ns or NEVER)
            if self._sent_ns == before_ns:
                return layout

    def build_layout(self) -> Layout:
        """Return the layout with all tasks, host boards and mailboxes of the segment."""
        mailboxes = [box for name in self._wiring.writers for box in self._build_mailboxes(name)]
        # The clock writes the operator's commands to the levels.
        mailboxes += [
            self._build_mailbox(name, writer=CLOCK, every=1, delay=1, depth=OPERATOR_DEPTH)
            for name in self._wiring.operator_mailboxes
        ]
        # Standbys follow all other tasks, whose indices therefore do not depend on them.
        standbys = [
            self._build_task(place)
            for place in self._config.list_standbys()
            if place.board in self._tasks
        ]
        specs = (*self._tasks.values(), *standbys)
        return Layout(
            rack=self._config.name,
            clock_ns=self._config.clock_ns,
            tasks=tuple(spec for spec in specs if spec.role != "host"),
            mailboxes=tuple(mailboxes),
            hosts=tuple(spec for spec in specs if spec.role == "host"),
        )

    def _build_mailboxes(self, name: str) -> Iterator[MailboxSpec]:
        """Yield the mailbox `name` and, if it is a queue, the mailbox for its reader's position."""
        ports, output = self._wiring.writers[name]
        capacity = self._config.protocol.depth.get(name, UNREAD)
        if name in self._wiring.mailboxes_from_host:
            # Host boards write queues whose messages become visible at once.
            depth = compute_depth(capacity + SPARE_SLOTS, 1)
            yield self._build_mailbox(
                name, writer=ports.task, every=1, delay=0, depth=depth, capacity=capacity
            )
            return
        writer = self._tasks[ports.task]
        every = writer.every * output.cycles
        delay = writer.slice
        # A message that is visible at the start of a reader's slice must not be overwritten before
        # the slice ends.
        readers = [self._tasks[reader] for reader in self._wiring.list_readers(name)]
        slowest = max((reader.slice for reader in readers), default=0)
        box = self._build_mailbox(
            name,
            writer=writer.name,
            every=every,
            delay=delay,
            depth=compute_depth(max(slowest + delay, self._retained_ticks), every),
            # A message is based on those of the input that its output declares, if any.
            rests_on=tuple(
                box
                for port, box in ports.sources
                if output.rests_on is not None
                and output.rests_on.name == port
                and self._wiring.find_protocol(box) != "queue"
            ),
            phase=writer.phase,
            max_age=round(output.max_age_s * 1e9 / self._config.clock_ns),
        )
        if box.protocol == "interrupt":
            yield self._add_interrupts(box, writer, readers)
        # A queue has no reader if the reader's board is left out because of mistakes.
        elif box.protocol == "queue" and readers:
            yield from self._build_queue(box, capacity, readers[0], writer)
        else:
            yield box

    def _build_queue(
        self, box: MailboxSpec, capacity: int, reader: TaskSpec, writer: TaskSpec
    ) -> Iterator[MailboxSpec]:
        """Yield a queue and the mailbox in which the reader reports which messages it has taken.

        Args:
            box: Record of the queue, whose capacity and depth are not set yet.
            capacity: Largest number of unread messages.
            reader: The task that reads the queue.
            writer: The task that writes it.
        """
        delay = reader.slice
        read = max((exchange.grid for exchange in box.exchanges), default=reader.grid)
        # The writer learns after the delays of both mailboxes which messages the reader has taken.
        # During that time it can send at most `capacity` messages.
        most_sent = capacity * (1 + self._retained_ticks // (box.delay + delay))
        # A deep queue retains fewer messages, to limit its memory.
        slots = compute_depth(
            min(most_sent, 2 * capacity + SUSTAINED * self._retained_ticks // box.every), 1
        )
        yield replace(box, capacity=capacity, depth=slots)
        yield self._build_mailbox(
            get_position_mailbox(box.name),
            QueueTaken.message_type,
            readers=(writer.name,),
            protocol="time-slice",
            writer=reader.name,
            every=read.every,
            delay=delay,
            depth=compute_depth(max(writer.slice + delay, self._retained_ticks), read.every),
            phase=(read.phase + delay) % read.every,
        )

    def _add_interrupts(
        self, box: MailboxSpec, writer: TaskSpec, readers: Sequence[TaskSpec]
    ) -> MailboxSpec:
        """Return a copy of a mailbox's record with the costs and times of its interrupts.

        Tasks in the writer's slot, host boards and the network adapter read shared memory and are
        not interrupted.

        Args:
            box: The mailbox, with the delay and depth of protocol time-slice.
            writer: The task that writes it.
            readers: The tasks that read it.
        """
        clock_ns = self._config.clock_ns
        table = self._config.protocol.interrupt
        uninterrupted = {
            task.slot
            for task in readers
            if task.role == "host" or self._wiring.belongs_to_network_adapter(task.board)
        }
        words = -(-box.size // WORD_BYTES)
        service_ns = round((table.fixed_us + table.word_us * words) * NS_PER_US)
        # A plan is sent at the end of its slice.
        sent_ns = writer.slice * clock_ns
        if writer.role != "planner":
            busy_ns = round(self._config.board[writer.board].busy_ms * NS_PER_MS) or clock_ns
            sent_ns = min(self._sent_ns.get(writer.name, busy_ns), sent_ns)
        slots = tuple(sorted({task.slot for task in readers} - uninterrupted - {writer.slot}))
        delay = -(-(sent_ns + service_ns * bool(slots)) // clock_ns)
        interrupt = InterruptSpec(
            sent_ns, service_ns, table.depth, -(-sent_ns // clock_ns), box.delay, slots
        )
        # A message must still be in its slot when the last pending interrupt is served.
        waits = -(-(table.depth + 1) * service_ns // clock_ns)
        slowest = max((reader.slice for reader in readers), default=0)
        depth = compute_depth(max(slowest + delay + waits, self._retained_ticks), box.every)
        return replace(box, delay=delay, depth=depth, interrupt=interrupt)

    def _build_task(self, place: TaskEntry) -> TaskSpec:
        """Return the record of a task. A host board has no rate and no trace."""
        common = {key: getattr(place, key) for key in ("name", "board", "role", "slot", "priority")}
        if place.role == "host":
            return TaskSpec(
                core=place.core,
                every=1,
                within_cycles=1,
                depth=0,
                is_external=self._config.host[place.board].external,
                **common,
            )
        board = self._config.board[place.board]
        every = self._wiring.periods[place.board]
        wake = board.wake or self._config.clock.wake
        is_planner = place.role == "planner"
        return TaskSpec(
            core=find_core(place.core),
            every=every,
            within_cycles=board.within_cycles if is_planner else 1,
            depth=compute_depth(self._retained_ticks, every),
            # Only the executor of a board may poll.
            wake="timer" if is_planner and wake == "poll" else wake,
            phase=board.phase,
            **common,
        )

    def _build_mailbox(
        self, name: str, kind: MessageType | None = None, **fields: Any
    ) -> MailboxSpec:
        """Return the record of a mailbox.

        Args:
            name: Name of the mailbox.
            kind: Its message type. None to take it from the port that writes the mailbox.
            fields: Further fields of the record. They override readers, protocol and exchanges.
        """
        wiring = self._wiring
        kind = kind or wiring.types[name]
        reading = wiring.reading_ports.get(name, ())
        derived = {
            "readers": wiring.list_readers(name),
            "protocol": wiring.find_protocol(name),
            "exchanges": tuple(
                build_exchanges(wiring, p)[port] for p, port in reading if port in p.exchange
            ),
        }
        return MailboxSpec(
            name=name,
            message=kind.name,
            version=kind.version,
            size=kind.build_dtype(self._sizes).itemsize,
            fields=build_field_specs(kind, self._sizes),
            **{**derived, **fields},
        )


def build_field_specs(kind: MessageType, sizes: Mapping[str, int]) -> tuple[FieldSpec, ...]:
    """Return the fields of a message type as plain data, with offsets, shapes and numpy types.

    With these records, tools can read the messages of a rack without the message classes.
    """
    offsets: Mapping[str, Any] = kind.build_dtype(sizes).fields or {}
    specs = []
    for field in kind.fields:
        dtype, offset = offsets[field.name][:2]
        scalar = dtype.base
        group = field.kind if isinstance(field.kind, MessageType) else None
        # The unit of an enum field is its class, which names its values.
        names = () if isinstance(field.unit, str) else field.unit
        specs.append(
            FieldSpec(
                name=field.name,
                kind=scalar.str if group is None else f"V{scalar.itemsize}",
                shape=dtype.shape,
                offset=offset,
                unit=field.unit if isinstance(field.unit, str) else field.unit.__name__,
                meaning=field.meaning,
                fields=() if group is None else build_field_specs(group, sizes),
                values=tuple((number.name.lower(), int(number)) for number in names),
                length=field.length,
            )
        )
    return tuple(specs)
