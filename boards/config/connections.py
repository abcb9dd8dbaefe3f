"""The wiring of a rack as plain data, made once from its config: the ports of all tasks, and the
mailboxes they share.

A port's source is a mailbox, or is relative to its board: "above.command", "below.status",
"own.plan". The config may connect a port to another mailbox. Whether all is right, the rules say
(`rack.boards.config.rules`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pydantic import BaseModel

from rack.backplane.errors import ClockError
from rack.backplane.layout import Protocol
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
from rack.boards.errors import Mistake
from rack.boards.exchange import EXCHANGE, exchange_message
from rack.boards.host.adapter import Adapter
from rack.boards.wiring import Source, mailboxes_of
from rack.levels.host_program import HostProgram
from rack.levels.level import Executor, MadePorts, Output, Planner, Program
from rack.levels.operator import OperatorCommand
from rack.levels.ports import InputPort

OWN_OPERATOR = "own.operator"
LevelClass = type[Executor] | type[Planner] | type[HostProgram]


@dataclass(frozen=True)
class TaskPorts:
    """The class of a task or host board, and the mailbox of each port.

    Attributes:
        place: Its place in the config.
        kind: Its class.
        inputs: The declarations of what it reads, by port.
        outputs: The declarations of what it writes, by port.
        reads: A mailbox by port or, for a port that reads many, a dict of mailboxes by board.
        exchange: When an executor reads its ports.
        mistakes: Why inputs that the class declares are not connected.
        is_whole: False if mistakes keep some ports unknown.
    """

    place: TaskPlace
    kind: LevelClass
    inputs: Mapping[str, InputPort[Any]]
    outputs: Mapping[str, Output[Any]]
    reads: Mapping[str, Source]
    exchange: Mapping[str, ExchangeConfig]
    mistakes: Sequence[Mistake]
    is_whole: bool

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


def _connected(
    config: RackConfig, place: TaskPlace, kind: LevelClass, types: Mapping[str, type[Message]]
) -> TaskPorts:
    """Return the ports of a task or host board.

    Args:
        config: The config of the rack.
        place: The place of the task in it.
        kind: Its class.
        types: The message classes of mailboxes, as far as they are known. Ports that the config
            makes have the types of other mailboxes.
    """
    mistakes: list[Mistake] = []
    reads = dict(_connections(config, place, kind.inputs, mistakes))
    exchange: Mapping[str, ExchangeConfig] = {}
    made = MadePorts()
    if issubclass(kind, Executor):
        board = config.board[place.board]
        exchange = board.exchange
        made = kind.made_ports(board.params, types)
    for port, entry in made.inputs.items():
        entry.name = port
        reads[port] = entry.source
    outputs = {**kind.outputs, **made.outputs}
    if exchange and made.is_whole:
        # An output of that name of its own stays.
        outputs.setdefault(EXCHANGE, Output(exchange_message(reads)))
    inputs = {**kind.inputs, **made.inputs}
    return TaskPorts(place, kind, inputs, outputs, reads, exchange, mistakes, made.is_whole)


def _class(place: TaskPlace) -> LevelClass:
    """Return the class of a task or host board. Raises `LookupError` if there is none."""
    if place.role == "executor":
        return find_class(place.target, Executor)
    if place.role == "planner":
        planner = find_class(place.target, Planner)
        if not planner.outputs:
            raise LookupError("the class has no 'output', the port of its plan")
        return planner
    program = find_class(place.target, HostProgram)
    if many := [port for port, entry in program.inputs.items() if entry.many]:
        raise LookupError(f"port '{many[0]}' reads many mailboxes; permitted on the host side: one")
    return program


def _connections(
    config: RackConfig,
    place: TaskPlace,
    inputs: Mapping[str, InputPort[Any]],
    mistakes: list[Mistake],
) -> Iterator[tuple[str, Source]]:
    """Yield what each input reads; of inputs that cannot be connected, add the mistakes."""
    table = config.table(place)
    wired = config.rewired(place)
    neighbours = {"own": (place.board,), "above": getattr(table, "above", ()), "below": table.below}
    others = config.board.keys() - {place.board}
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        boards = neighbours.get(start, (start,))
        key = f"{place.reads_key}.{port}" if port in wired else start
        mailboxes = wired.get(port, tuple(f"{board}.{rest}" for board in boards))
        what = f"port '{port}' of the {place.role}"
        if not mailboxes and not entry.optional:
            mistakes.append(Mistake(f"{place.table}.{start}", None, f"missing; {what} needs it"))
        elif len(mailboxes) > 1 and not entry.many:
            why = f"{what} reads one mailbox, not {len(mailboxes)}"
            mistakes.append(Mistake(f"{place.table}.{key}", wired.get(port, boards), why))
        elif key not in ("above", "below") or others.issuperset(boards):
            yield port, _by_board(mailboxes) if entry.many else mailboxes[0]


def _by_board(mailboxes: Sources) -> Source:
    """Return mailboxes by board, or by their names if one board writes several."""
    boards = [box.partition(".")[0] for box in mailboxes]
    found = zip(boards, mailboxes, strict=True)
    return {board if boards.count(board) == 1 else box: box for board, box in found}


class Wiring:
    """The ports of all tasks and host boards, connected.

    Attributes:
        config: The config of the rack.
        broken: Tables that the config lacks since they have mistakes of their own, as in
            "board.servo".
        ports: The ports of all tasks and host boards that have a class, in order.
        missing: Why there is no class, of the others.
    """

    def __init__(self, config: RackConfig, broken: frozenset[str] = frozenset()) -> None:
        self.config = config
        self.broken = broken
        kinds: dict[TaskPlace, LevelClass] = {}
        self.missing: dict[TaskPlace, str] = {}
        for place in (*config.tasks(), *config.hosts()):
            try:
                kinds[place] = _class(place)
            except LookupError as error:
                self.missing[place] = str(error.args[0])
        types: dict[str, type[Message]] = {}
        while True:
            self.ports = {
                place: _connected(config, place, kind, types) for place, kind in kinds.items()
            }
            written = {
                box: ports.outputs[port].message
                for ports in self.ports.values()
                for port, box in ports.writes.items()
            }
            # What one board makes another may pass on.
            if len(written) == len(types):
                return
            types = written

    @property
    def broken_boards(self) -> list[str]:
        """The boards whose tables are broken."""
        return [name.removeprefix("board.") for name in self.broken if name.startswith("board.")]

    @property
    def tasks(self) -> list[TaskPorts]:
        """The ports of the tasks."""
        return [ports for ports in self.ports.values() if ports.place.role != "host"]

    @property
    def hosts(self) -> list[TaskPorts]:
        """The ports of the host boards."""
        return [ports for ports in self.ports.values() if ports.place.role == "host"]

    @cached_property
    def writers(self) -> dict[str, tuple[TaskPorts, Output[Any]]]:
        """The first task that writes each mailbox, and its declaration."""
        found: dict[str, tuple[TaskPorts, Output[Any]]] = {}
        for ports in self.ports.values():
            for port, mailbox in ports.writes.items():
                found.setdefault(mailbox, (ports, ports.outputs[port]))
        return found

    @cached_property
    def reading(self) -> dict[str, list[tuple[TaskPorts, str]]]:
        """Tasks and their ports that read each mailbox."""
        found: dict[str, list[tuple[TaskPorts, str]]] = {}
        for ports in self.ports.values():
            for port, mailbox in ports.sources:
                found.setdefault(mailbox, []).append((ports, port))
        return found

    @cached_property
    def operated(self) -> list[str]:
        """The operators' mailboxes."""
        found = executors(self.config).items()
        return [f"{board}.operator" for board, kind in found if takes_commands(kind)]

    @cached_property
    def types(self) -> dict[str, MessageType]:
        """The message type of every mailbox."""
        written = {name: output.message.message_type for name, (_, output) in self.writers.items()}
        return written | dict.fromkeys(self.operated, OperatorCommand.message_type)

    @property
    def names(self) -> str:
        """The names of all mailboxes, as a list to read."""
        return ", ".join(self.types)

    @cached_property
    def from_host(self) -> set[str]:
        """The mailboxes that host boards write."""
        return {mailbox for ports in self.hosts for mailbox in ports.writes.values()}

    @cached_property
    def passed(self) -> dict[str, str]:
        """The mailboxes that bus adapters write, with those that they pass on."""
        return {
            f"{ports.place.board}.{port}": source
            for ports in self.tasks
            if ports.joins_sides
            for port, source in ports.sources
        }

    @cached_property
    def to_host(self) -> set[str]:
        """The mailboxes that bus adapters write for host boards."""
        return {mailbox for mailbox, box in self.passed.items() if box not in self.from_host}

    @property
    def of_host(self) -> set[str]:
        """The host side. Only a bus adapter reads on one side and writes on the other."""
        return self.from_host | self.to_host

    @cached_property
    def every(self) -> dict[str, int]:
        """The periods of the boards whose rate is on the clock's grid, ticks."""
        found: dict[str, int] = {}
        for name in self.config.board if "clock" not in self.broken else ():
            with suppress(ClockError):
                found[name] = self.config.every(name)
        return found

    @cached_property
    def unknown(self) -> set[str]:
        """Boards with mistakes of their own: a reader that lacks a mailbox of theirs is not at
        fault.
        """
        found = {place.board for place in self.missing}
        found |= {ports.place.board for ports in self.ports.values() if not ports.is_whole}
        found |= {place.removeprefix("board.").removeprefix("host.") for place in self.broken}
        is_lan_unknown = "adapter" in self.broken or is_taken(self.config)
        return found | {LAN} if is_lan_unknown else found

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
        """Return whether a mailbox exists, or may: its board has mistakes of its own."""
        return mailbox in self.types or mailbox.partition(".")[0] in self.unknown

    def readers(self, mailbox: str) -> tuple[str, ...]:
        """Return the tasks and host boards that read a mailbox."""
        return tuple(dict.fromkeys(ports.task for ports, _ in self.reading.get(mailbox, ())))

    def is_of_network(self, name: str) -> bool:
        """Return whether a board is the network adapter, or a mailbox one that it writes."""
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


def takes_commands(executor: type[Executor]) -> bool:
    """Return True if a level reads the commands of an operator."""
    return any(port.source == OWN_OPERATOR for port in executor.inputs.values())


def is_taken(config: RackConfig) -> bool:
    """Say whether another board has the name of the network adapter's."""
    # If the others are broken, its own is not there either.
    return (
        config.adapter.lan is not None
        and LAN in config.board
        and config.board[LAN] != config.adapter.lan.board()
    )
