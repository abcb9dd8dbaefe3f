"""From a config to its layout: all mailboxes and tasks of a rack, as plain data for its segment."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydantic import ValidationError

from rack.backplane.address_map import CLOCK, AddressMap
from rack.backplane.errors import MailboxError
from rack.backplane.layout import ExchangeSpec, FieldSpec, Layout, MailboxSpec, Protocol, TaskSpec, Wake, depth_for
from rack.backplane.mailbox.host_ring import SPARE
from rack.backplane.mailbox.queue import TAKEN, taken_name
from rack.backplane.message import MessageType
from rack.boards.config.commands import commandable
from rack.boards.config.interrupts import interrupt_mistakes, is_exempt, with_interrupts
from rack.boards.config.mistakes import mistakes_of
from rack.boards.config.ports import TaskPorts, all_ports, table_of
from rack.boards.config.protocols import UNREAD
from rack.boards.config.queues import queue_mistakes, queue_slots
from rack.boards.config.rules.lan import entry_mistakes, is_taken
from rack.boards.config.rules.protocols import asynchronous_mistakes, exchanges, strict_mistakes
from rack.boards.config.rules.reads import Sides, key_of
from rack.boards.config.schema import LAN, RackConfig, TaskPlace
from rack.boards.errors import Mistake
from rack.levels.level import Output
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.tables import GoalConfig

OPERATOR_DEPTH = 128
"""Slots of an operator's mailbox; commands are rare."""
NOT_OPERATED = {
    "lock": "the clock writes it and must not wait",
    "queue": "it keeps every command already",
    "interrupt": "the clock writes it, not a board",
}
"""Protocols that an operator's mailbox cannot have, and why."""
MAX_SEGMENT_BYTES = 2**30
KEPT_S = 2.0
"""Simulated time that mailboxes and trace rings retain for a recorder, which real-time boards may starve for 1 s."""


def obtained_core(core: int) -> int:
    """Return the core for a task that requests `core`; cores that the machine lacks map to the others in turn."""
    available = sorted(os.sched_getaffinity(0))
    return core if core in available else available[core % len(available)]


def shared_out(config: RackConfig) -> list[str]:
    """Return a line for every requested core that does not exist, for the launch to print."""
    wanted: dict[int, list[str]] = {config.clock.core: [CLOCK]}
    for place in config.tasks():
        wanted.setdefault(place.core, []).append(place.name)
    available = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
    return [
        f"core {core} is not available (available: {available}): core {obtained_core(core)} runs {', '.join(tasks)}"
        for core, tasks in sorted(wanted.items())
        if obtained_core(core) != core
    ]


class Wiring:
    """The ports of all tasks, connected: the writer and the readers of each mailbox.

    `writers` holds the writing task and its declaration by mailbox, `operated` the message types of operators'
    mailboxes. `mistakes` holds every mistake in them. Nothing that depends on the tables in `broken`, which have
    mistakes of their own, is checked.
    """

    def __init__(self, config: RackConfig, broken: frozenset[str] = frozenset()) -> None:
        self.config = config
        self.mistakes: list[Mistake] = [*strict_mistakes(config)]
        self._ports = all_ports(config, self.mistakes)
        self.tasks = [ports for ports in self._ports if ports.place.role != "host"]
        self.hosts = [ports for ports in self._ports if ports.place.role == "host"]
        self.sides = Sides(self._ports)
        places = [*config.tasks(), *config.hosts()]
        found = {ports.task for ports in self._ports if ports.is_whole}
        # The mailboxes of such boards are unknown, so a reader that lacks one is not at fault.
        self._unknown = {place.board for place in places if place.name not in found}
        self._unknown |= {place.removeprefix("board.").removeprefix("host.") for place in broken}
        self._unknown |= {LAN} if "adapter" in broken or is_taken(config) else set()
        self.writers: dict[str, tuple[TaskPorts, Output]] = {}
        for ports in self._ports:
            self._add_writer(ports)
        self.operated = {f"{board}.operator": OPERATOR_COMMAND for board in commandable(config)}
        self._check_operated()
        for ports in self._ports:
            self._check_reads(ports)
        self._check_rest()
        self.mistakes += entry_mistakes(self, has_clock="clock" not in broken)
        crossing = list(self.sides.mistakes(self._unknown))
        self.mistakes += crossing or queue_mistakes(self)
        self.mistakes += [*asynchronous_mistakes(self), *interrupt_mistakes(self)]
        self._check_params()
        self.goals: list[GoalConfig] = []  # of the programs
        if not broken & {"robot", "scene", "task"}:
            self._check_programs()

    def _add_writer(self, ports: TaskPorts) -> None:
        for port, mailbox in ports.writes.items():
            if mailbox in self.writers:
                first = self.writers[mailbox][0].task
                self.mistakes.append(Mistake(f"mailbox {mailbox}", ports.task, f"already written by {first}"))
            else:
                self.writers[mailbox] = ports, ports.outputs[port]

    def _check_operated(self) -> None:
        """Check that only the clock writes operators' mailboxes, never waits, and never finds one full."""
        for mailbox in self.operated:
            if mailbox in self.writers:
                first = self.writers[mailbox][0].task
                self.mistakes.append(
                    Mistake(f"mailbox {mailbox}", first, "only the clock writes an operator's mailbox")
                )
            given = self.config.protocol.mailbox.get(mailbox)
            if why := NOT_OPERATED.get(given or ""):
                why += "; permitted: time-slice, double-buffer"
                self.mistakes.append(Mistake(f"protocol.mailbox.{mailbox}", given, why))

    def _check_reads(self, ports: TaskPorts) -> None:
        for port, mailbox in ports.sources:
            place, wanted = f"{table_of(ports.place)}.{key_of(ports)}.{port}", ports.inputs[port].type
            if not self.is_known(mailbox):
                why = f"no task writes it; mailboxes: {self.names()}"
                self.mistakes.append(Mistake(place, mailbox, why))
            elif ports.is_whole and (found := self._kind(mailbox)) is not None and found != wanted:
                why = f"carries {found.name} {found.version}; the port needs {wanted.name} {wanted.version}"
                self.mistakes.append(Mistake(place, mailbox, why))

    def _check_rest(self) -> None:
        for mailbox in self.config.protocol.mailbox:
            if not self.is_known(mailbox):
                why = f"no such mailbox; mailboxes: {self.names()}"
                self.mistakes.append(Mistake(f"protocol.mailbox.{mailbox}", None, why))
        for name, board in self.config.board.items():
            if board.ends_run and not self.is_known(f"{name}.status"):
                self.mistakes.append(Mistake(f"board.{name}.ends_run", True, "its executor writes no status"))

    def _check_params(self) -> None:
        """Check each board's parameters against the declarations of its executor's and planner's classes."""
        kinds = [(table_of(ports.place), ports.kind.params) for ports in self._ports if ports.kind.params is not None]
        for table, kind in dict.fromkeys(kinds):
            tables, _, board = table.partition(".")
            params = getattr(self.config, tables)[board].params
            try:
                kind.model_validate(params)
            except ValidationError as error:
                self.mistakes += mistakes_of(error, kind, params, f"{table}.params")

    def _check_programs(self) -> None:
        """Check `[task]` against the programs declared by the levels' classes."""
        for kind in dict.fromkeys(ports.kind.program for ports in self._ports if ports.kind.program is not None):
            try:
                program = kind.model_validate(self.config.task)
            except ValidationError as error:
                self.mistakes += mistakes_of(error, kind, self.config.task, "task")
            else:
                misfits = program.misfits(self.config.robot, self.config.scene)
                self.mistakes += [Mistake(f"task.{key}", value, why) for key, value, why in misfits]
                self.goals += program.goals()

    @property
    def has_unknown(self) -> bool:
        """Whether the ports of some boards are not known, since these have mistakes of their own."""
        return bool(self._unknown)

    def is_known(self, mailbox: str) -> bool:
        """Say whether a mailbox exists, or may: its board has mistakes of its own."""
        return mailbox in self.writers or mailbox in self.operated or mailbox.partition(".")[0] in self._unknown

    def _kind(self, mailbox: str) -> MessageType | None:
        return self.writers[mailbox][1].type if mailbox in self.writers else self.operated.get(mailbox)

    def names(self) -> str:
        """Return the names of all mailboxes, as a list to read."""
        return ", ".join([*self.writers, *self.operated])

    def check_sizes(self, sizes: Mapping[str, int]) -> list[Mistake]:
        """Return a mistake for every message that needs a size unknown to the rack."""
        found = []
        for mailbox, (ports, output) in self.writers.items():
            try:
                output.type.dtype(sizes)
            except MailboxError as error:
                found.append(Mistake(f"mailbox {mailbox}", ports.task, str(error)))
        return found

    def layout(self, sizes: Mapping[str, int]) -> Layout:
        """Return the layout of a config without mistakes."""
        tasks = tuple(self._task(ports) for ports in self.tasks)
        hosts = tuple(self._host(ports.place) for ports in self.hosts)
        by_name = {task.name: task for task in tasks + hosts}
        mailboxes: list[MailboxSpec] = []
        for name, (ports, output) in self.writers.items():
            if name in self.sides.from_host:
                mailboxes.append(self._ring(name, ports.task, output.type, sizes))
                continue
            writer = by_name[ports.task]
            every = writer.every * output.cycles
            delay = writer.every * writer.within_cycles
            # A reader may read as late as the end of its slice a message that was visible at its start.
            readers = [by_name[reader] for reader in self.readers(name)]
            slowest = max((reader.every * reader.within_cycles for reader in readers), default=0)
            depth = depth_for(max(slowest + delay, self._kept_ticks), every)
            rests_on = tuple(box for box in ports.rests_on(name.partition(".")[2]) if self.protocol(box) != "queue")
            spec = partial(MailboxSpec, writer=writer.name, every=every, delay=delay, depth=depth, rests_on=rests_on)
            max_age = round(output.max_age_s * 1e9 / self.config.clock_ns)
            box = self._mailbox(name, output.type, sizes, partial(spec, phase=writer.phase, max_age=max_age))
            if box.protocol == "interrupt":
                box = with_interrupts(self.config, box, by_name, self._kept_ticks)
            mailboxes += self._queue(box, readers[0], writer) if box.protocol == "queue" else [box]
        # The clock passes an operator's commands on.
        operators = partial(MailboxSpec, writer=CLOCK, every=1, delay=1, depth=OPERATOR_DEPTH)
        mailboxes += [self._mailbox(name, kind, sizes, operators) for name, kind in self.operated.items()]
        return Layout(self.config.name, self.config.clock_ns, tasks, tuple(mailboxes), hosts)

    def _ring(self, name: str, host: str, kind: MessageType, sizes: Mapping[str, int]) -> MailboxSpec:
        """Return the mailbox of a host board: a queue that is not by ticks."""
        capacity = self.config.protocol.depth.get(name, UNREAD)
        depth = depth_for(capacity + SPARE, 1)
        return self._mailbox(
            name, kind, sizes, partial(MailboxSpec, writer=host, every=1, delay=0, capacity=capacity, depth=depth)
        )

    def _queue(self, box: MailboxSpec, reader: TaskSpec, writer: TaskSpec) -> Iterator[MailboxSpec]:
        """Yield a queue with its size, and the mailbox in which its reader writes its position for the writer."""
        delay, slowest = reader.every * reader.within_cycles, writer.every * writer.within_cycles
        read = max((exchange.grid for exchange in box.exchanges), default=reader.grid)
        capacity = self.config.protocol.depth.get(box.name, UNREAD)
        slots = queue_slots(capacity, box.every, box.delay + delay, self._kept_ticks)
        yield replace(box, capacity=capacity, depth=slots)
        depth = depth_for(max(slowest + delay, self._kept_ticks), read.every)
        visible = (read.phase + delay) % read.every
        spec = partial(MailboxSpec, writer=reader.name, every=read.every, delay=delay, depth=depth, phase=visible)
        position = self._mailbox(taken_name(box.name), TAKEN, {}, spec)
        yield replace(position, readers=(writer.name,), protocol="time-slice")

    def _task(self, ports: TaskPorts) -> TaskSpec:
        place, every = ports.place, self.config.every(ports.place.board)
        return TaskSpec(
            name=place.name,
            board=place.board,
            role=place.role,
            slot=place.slot,
            core=obtained_core(place.core),
            priority=place.priority,
            every=every,
            within_cycles=self.config.board[place.board].within_cycles if place.role == "planner" else 1,
            depth=depth_for(self._kept_ticks, every),
            wake=self._wake(place),
            phase=self.config.board[place.board].phase,
        )

    def _host(self, place: TaskPlace) -> TaskSpec:
        """Return the record of a host board: it has no rate, and leaves no trace."""
        is_external = self.config.host[place.board].external
        return TaskSpec(
            place.name, place.board, place.role, place.slot, place.core, 0, 1, 1, 0, is_external=is_external
        )

    def _wake(self, place: TaskPlace) -> Wake:
        """Return how a task waits for its next cycle. The planner of a polling executor must not poll too."""
        wake = self.config.board[place.board].wake or self.config.clock.wake
        return "timer" if wake == "poll" and place.role == "planner" else wake

    @property
    def _kept_ticks(self) -> int:
        return round(KEPT_S * 1e9 / self.config.clock_ns)

    def _mailbox(
        self, name: str, kind: MessageType, sizes: Mapping[str, int], spec: Callable[..., MailboxSpec]
    ) -> MailboxSpec:
        """Complete the record of a mailbox by its message, readers and protocol."""
        return spec(
            name=name,
            readers=self.readers(name),
            exchanges=tuple(self._exchanges(name)),
            protocol=self.protocol(name),
            message=kind.name,
            version=kind.version,
            size=kind.dtype(sizes).itemsize,
            fields=field_specs(kind, sizes),
        )

    def readers(self, mailbox: str) -> tuple[str, ...]:
        """Return the tasks and host boards that read a mailbox."""
        return tuple(ports.task for ports in self._ports if any(mailbox == box for _, box in ports.sources))

    def _exchanges(self, mailbox: str) -> Iterator[ExchangeSpec]:
        for ports in self.tasks:
            found = exchanges(self.config, ports.place.board) if ports.place.role == "executor" else {}
            yield from (found[port] for port, box in ports.sources if box == mailbox and port in found)

    def protocol(self, mailbox: str) -> Protocol:
        """Return the protocol of a mailbox."""
        if mailbox in self.sides.to_host:
            # Host boards read the newest message at once, whatever the protocol.
            return "time-slice"
        if mailbox in self.sides.from_host or (mailbox in self.writers and self.writers[mailbox][1].queued):
            return "queue"
        protocol = self.config.protocol.mailbox.get(mailbox, self.config.protocol.default)
        if protocol == "interrupt" and is_exempt(self, mailbox):
            return "time-slice"
        # A lock would make the clock wait for readers.
        return "double-buffer" if protocol == "lock" and mailbox in self.operated else protocol


def too_large(layout: Layout) -> Iterable[Mistake]:
    """Yield a mistake that names the largest mailbox if the segment is too large."""
    size = AddressMap(layout).size
    if size > MAX_SEGMENT_BYTES:
        box = max(layout.mailboxes, key=lambda mailbox: mailbox.depth * mailbox.size)
        why = f"{box.depth} messages are kept for its slowest reader, so the segment needs {size} bytes"
        advice = f"permitted: {MAX_SEGMENT_BYTES}; shorten cycles or within_cycles"
        yield Mistake(f"mailbox {box.name}", None, f"{why}; {advice}")


def field_specs(kind: MessageType, sizes: Mapping[str, int]) -> tuple[FieldSpec, ...]:
    """Return the fields of a message type with offsets, shapes and numpy types, for tools that attach by name."""
    offsets: Mapping[str, Any] = kind.dtype(sizes).fields or {}
    specs = []
    for field in kind.fields:
        dtype, offset = offsets[field.name][:2]
        scalar, shape = dtype.subdtype or (dtype, ())
        is_group = isinstance(field.kind, MessageType)
        specs.append(
            FieldSpec(
                name=field.name,
                kind=f"V{scalar.itemsize}" if is_group else np.dtype(scalar).str,
                shape=tuple(shape),
                offset=offset,
                unit=field.unit if isinstance(field.unit, str) else field.unit.__name__,
                meaning=field.meaning,
                fields=field_specs(field.kind, sizes) if isinstance(field.kind, MessageType) else (),
                values=() if isinstance(field.unit, str) else tuple((n.name.lower(), int(n)) for n in field.unit),
                length=field.length,
            )
        )
    return tuple(specs)
