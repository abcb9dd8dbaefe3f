"""The wiring of a rack as plain data, made once from its config: the ports of all tasks, and the
mailboxes they share.

A port's source is a mailbox, or is relative to its board: "above.command", "below.status",
"own.plan". The config may connect a port to another mailbox. Whether all is right, the rules say
(`rack.boards.config.rules`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from pydantic import BaseModel

from rack.backplane.errors import ClockError
from rack.backplane.layout import Protocol, Role
from rack.backplane.message import Message
from rack.backplane.message_type import MessageType
from rack.boards.classes import find_class
from rack.boards.config.schema import (
    LAN,
    ExchangeConfig,
    RackConfig,
    Sources,
    TaskPlace,
)
from rack.boards.exchange import EXCHANGE, exchange_message
from rack.boards.host.adapter import Adapter
from rack.boards.wiring import Source, mailboxes_of
from rack.levels.host_program import HostProgram
from rack.levels.level import Executor, Output, Planner, Program
from rack.levels.operator import Commands, OperatorCommand
from rack.levels.ports import InputPort

OWN_OPERATOR = "own.operator"
LevelClass = type[Executor] | type[Planner] | type[HostProgram]


class Connection(NamedTuple):
    """How a config connects an input: the key that says so, what it gives there, and the mailboxes
    that follow."""

    port: str
    entry: InputPort[Any]
    key: str
    given: Sources
    mailboxes: Sources
    is_there: bool = True
    """Whether the boards that it names exist."""

    @property
    def fits(self) -> bool:
        """Whether the port can read so many mailboxes."""
        count = len(self.mailboxes)
        return count > 0 or self.entry.optional if self.entry.many else count == 1

    @property
    def source(self) -> Source:
        """What the port reads: a mailbox, or mailboxes by board, or by their names if one board
        writes several."""
        if not self.entry.many:
            return self.mailboxes[0]
        boards = [box.partition(".")[0] for box in self.mailboxes]
        found = zip(boards, self.mailboxes, strict=True)
        return {board if boards.count(board) == 1 else box: box for board, box in found}


@dataclass(frozen=True)
class TaskPorts:
    """The class of a task or host board, and the mailbox of each port.

    `reads` holds a mailbox by port or, for a port that reads many, a dict of mailboxes by board;
    `inputs` and `outputs` the declarations of the ports; `exchange` when an executor reads them;
    `connections` where the inputs that its class declares are connected; not `is_whole` if mistakes
    keep some ports unknown.
    """

    place: TaskPlace
    kind: LevelClass
    inputs: Mapping[str, InputPort[Any]]
    outputs: Mapping[str, Output[Any]]
    reads: Mapping[str, Source]
    exchange: Mapping[str, ExchangeConfig]
    connections: tuple[Connection, ...]
    is_whole: bool = True

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.place.name

    @property
    def joins_sides(self) -> bool:
        """Whether it is the bus adapter between boards and host boards."""
        return issubclass(self.kind, Adapter) and self.kind.joins_sides

    @cached_property
    def sources(self) -> list[tuple[str, str]]:
        """Port and mailbox of everything that the task reads."""
        return [
            (port, mailbox)
            for port, source in self.reads.items()
            for mailbox in mailboxes_of(source)
        ]

    @cached_property
    def writes(self) -> dict[str, str]:
        """The mailboxes that the task writes, by port."""
        return {port: f"{self.place.board}.{port}" for port in self.outputs}

    def rests_on(self, output: str) -> tuple[str, ...]:
        """Return the mailboxes on whose information an output rests."""
        source = self.outputs[output].rests_on
        return () if source is None else mailboxes_of(self.reads.get(source.name, {}))


def rewired(config: RackConfig, place: TaskPlace) -> Mapping[str, Sources]:
    """Return the mailboxes that a config gives to ports of a task or host board, by port."""
    found: Mapping[str, Sources] = getattr(config.table(place), place.reads_key)
    return found


def declared_ports(config: RackConfig, place: TaskPlace) -> TaskPorts:
    """Return the ports that the class of a task or host board declares. Raises `LookupError` if
    there is none."""
    kind, outputs = _class(place.target, place.role)
    connections = tuple(_connections(config, place, kind.inputs))
    reads = {c.port: c.source for c in connections if c.fits and c.is_there}
    exchange = config.board[place.board].exchange if place.role == "executor" else {}
    return TaskPorts(place, kind, kind.inputs, outputs, reads, exchange, connections)


def with_made_ports(
    config: RackConfig, ports: TaskPorts, types: Mapping[str, type[Message]]
) -> TaskPorts:
    """Add the ports that the config makes: their types may be those of other mailboxes."""
    if not issubclass(ports.kind, Executor):
        return ports
    made = ports.kind.made_ports(config.board[ports.place.board].params, types)
    for port, entry in made.inputs.items():
        entry.name = port
    return replace(
        ports,
        inputs={**ports.inputs, **made.inputs},
        outputs={**ports.outputs, **made.outputs},
        reads={**ports.reads, **{port: entry.source for port, entry in made.inputs.items()}},
        is_whole=made.is_whole,
    )


def with_exchange(ports: TaskPorts) -> TaskPorts:
    """Add the mailbox of the exchange to a board whose config has one; one of that name of its own
    stays."""
    if not ports.exchange or not ports.is_whole:
        return ports
    outputs = dict(ports.outputs)
    outputs.setdefault(EXCHANGE, Output(exchange_message(ports.reads)))
    return replace(ports, outputs=outputs)


def _class(wanted: str, role: Role) -> tuple[LevelClass, Mapping[str, Output[Any]]]:
    if role == "host":
        program = find_class(wanted, HostProgram)
        if many := [port for port, entry in program.inputs.items() if entry.many]:
            raise LookupError(
                f"port '{many[0]}' reads many mailboxes; permitted on the host side: one"
            )
        return program, program.outputs
    if role == "executor":
        executor = find_class(wanted, Executor)
        return executor, executor.outputs
    planner = find_class(wanted, Planner)
    if not planner.outputs:
        raise LookupError("the class has no 'output', the port of its plan")
    return planner, planner.outputs


def _connections(
    config: RackConfig, place: TaskPlace, inputs: Mapping[str, InputPort[Any]]
) -> Iterator[Connection]:
    own = {place.board}
    wired = rewired(config, place)
    table = config.table(place)
    neighbours = {"own": (place.board,), "above": getattr(table, "above", ()), "below": table.below}
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        if port in wired:
            yield Connection(port, entry, f"{place.reads_key}.{port}", wired[port], wired[port])
            continue
        boards = neighbours.get(start, (start,))
        is_there = start not in ("above", "below") or {*boards} <= config.board.keys() - own
        yield Connection(
            port, entry, start, boards, tuple(f"{board}.{rest}" for board in boards), is_there
        )


class Wiring:
    """The ports of all tasks and host boards, connected.

    `broken` names the tables that the config lacks since they have mistakes of their own, as in
    "board.servo".
    """

    def __init__(self, config: RackConfig, broken: frozenset[str] = frozenset()) -> None:
        self.config = config
        self.broken = broken
        self.broken_boards = [
            place.removeprefix("board.") for place in broken if place.startswith("board.")
        ]
        self.missing: dict[TaskPlace, str] = {}
        """Why there is no class, of the tasks and host boards without one."""
        self.ports = self._connected()
        """The ports of all others, in order."""
        self.tasks = [ports for ports in self.ports.values() if ports.place.role != "host"]
        self.hosts = [ports for ports in self.ports.values() if ports.place.role == "host"]
        self.writers: dict[str, tuple[TaskPorts, Output[Any]]] = {}
        """The first task that writes each mailbox, and its declaration."""
        self.reading: dict[str, list[tuple[TaskPorts, str]]] = {}
        """Tasks and their ports that read each mailbox."""
        for ports in self.ports.values():
            for port, mailbox in ports.writes.items():
                self.writers.setdefault(mailbox, (ports, ports.outputs[port]))
            for port, mailbox in ports.sources:
                self.reading.setdefault(mailbox, []).append((ports, port))
        self.operated = {
            f"{board}.operator": OperatorCommand.message_type for board in commandable(config)
        }
        """The message types of operators' mailboxes."""
        self.from_host = {mailbox for ports in self.hosts for mailbox in ports.writes.values()}
        """The mailboxes that host boards write."""
        self.passed = {
            f"{ports.place.board}.{port}": source
            for ports in self.tasks
            if ports.joins_sides
            for port, source in ports.sources
        }
        """The mailboxes that bus adapters write, with those that they pass on."""
        self.to_host = {
            mailbox for mailbox, source in self.passed.items() if source not in self.from_host
        }
        self.of_host = self.from_host | self.to_host
        """The host side. Only a bus adapter reads on one side and writes on the other."""
        self.every = dict(self._periods())
        """The periods of the boards whose rate is on the clock's grid, ticks."""
        whole = {ports.task for ports in self.ports.values() if ports.is_whole}
        self.unknown = {
            place.board for place in (*self.missing, *self.ports) if place.name not in whole
        }
        """Boards with mistakes of their own: a reader that lacks a mailbox of theirs is not at
        fault."""
        self.unknown |= {place.removeprefix("board.").removeprefix("host.") for place in broken}
        self.unknown |= {LAN} if "adapter" in broken or is_taken(config) else set()

    def _connected(self) -> dict[TaskPlace, TaskPorts]:
        config = self.config
        declared = dict[TaskPlace, TaskPorts]()
        types = dict[str, type[Message]]()
        for place in (*config.tasks(), *config.hosts()):
            try:
                declared[place] = declared_ports(config, place)
            except LookupError as error:
                self.missing[place] = str(error.args[0])
        found = declared
        before = -1
        # What one board makes another may pass on.
        while len(types) != before:
            before = len(types)
            types = {
                box: p.outputs[port].message
                for p in found.values()
                for port, box in p.writes.items()
            }
            found = {
                place: with_made_ports(config, ports, types) for place, ports in declared.items()
            }
        return {place: with_exchange(ports) for place, ports in found.items()}

    def _periods(self) -> Iterator[tuple[str, int]]:
        if "clock" in self.broken:
            return
        for name in self.config.board:
            with suppress(ClockError):
                yield name, self.config.every(name)

    @property
    def params(self) -> Iterable[tuple[str, type[BaseModel]]]:
        """The tables with parameters, as in "board.servo", and their records, each once."""
        found = self.ports.items()
        return dict.fromkeys(
            (place.table, p.kind.params) for place, p in found if p.kind.params is not None
        )

    @property
    def programs(self) -> Iterable[type[Program]]:
        """The records of the programs of levels that read `[task]`, each once."""
        return dict.fromkeys(
            p.kind.program for p in self.ports.values() if p.kind.program is not None
        )

    def is_known(self, mailbox: str) -> bool:
        """Say whether a mailbox exists, or may: its board has mistakes of its own."""
        return self.type_of(mailbox) is not None or mailbox.partition(".")[0] in self.unknown

    def type_of(self, mailbox: str) -> MessageType | None:
        """Return the message type of a mailbox; None if it does not exist."""
        return (
            self.writers[mailbox][1].message.message_type
            if mailbox in self.writers
            else self.operated.get(mailbox)
        )

    def names(self) -> str:
        """Return the names of all mailboxes, as a list to read."""
        return ", ".join([*self.writers, *self.operated])

    def readers(self, mailbox: str) -> tuple[str, ...]:
        """Return the tasks and host boards that read a mailbox."""
        return tuple(dict.fromkeys(ports.task for ports, _ in self.reading.get(mailbox, ())))

    def is_of_network(self, name: str) -> bool:
        """Say whether a board is the network adapter, or a mailbox one that it writes."""
        return self.config.adapter.lan is not None and name.partition(".")[0] == LAN

    def protocol(self, mailbox: str) -> Protocol:
        """Return the protocol of a mailbox."""
        if mailbox in self.to_host:
            # Host boards read the newest message at once, whatever the protocol.
            return "time-slice"
        if mailbox in self.from_host or (
            mailbox in self.writers and self.writers[mailbox][1].queued
        ):
            return "queue"
        protocol = self.config.protocol.mailbox.get(mailbox, self.config.protocol.default)
        if protocol == "interrupt" and (mailbox in self.operated or self.is_of_network(mailbox)):
            # No board of the rack sends its messages.
            return "time-slice"
        # A lock would make the clock wait for readers.
        return "double-buffer" if protocol == "lock" and mailbox in self.operated else protocol


def executors(config: RackConfig) -> dict[str, type[Executor]]:
    """Return the class of each board's executor; those that are missing are reported elsewhere."""
    found: dict[str, type[Executor]] = {}
    for name, board in config.board.items():
        with suppress(LookupError):
            found[name] = find_class(board.executor, Executor)
    return found


def commandable(config: RackConfig) -> dict[str, Commands]:
    """Return the commands that each level takes from an operator, by board; levels that take none
    are omitted."""
    return {
        name: executor.commands
        for name, executor in executors(config).items()
        if any(port.source == OWN_OPERATOR for port in executor.inputs.values())
    }


def is_taken(config: RackConfig) -> bool:
    """Say whether another board has the name of the network adapter's."""
    # If the others are broken, its own is not there either.
    return (
        config.adapter.lan is not None
        and LAN in config.board
        and config.board[LAN] != config.adapter.lan.board()
    )
