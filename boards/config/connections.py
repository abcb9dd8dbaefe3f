"""Wiring of a rack, computed from its config: which task reads and writes which mailboxes.

The source of a port is a mailbox, or it is relative to the board: "above.command", "below.status",
"own.plan". The config may connect a port to another mailbox. `rack.boards.config.rules` checks the
result.
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
from rack.boards.config.schedulers import names_scheduler
from rack.boards.config.schema import (
    LAN,
    ExchangeConfig,
    RackConfig,
    Sources,
    TaskEntry,
)
from rack.boards.errors import Mistake
from rack.boards.exchange import EXCHANGE_PORT, build_exchange_message
from rack.boards.host.adapter import Adapter
from rack.boards.wiring import Source, list_mailboxes
from rack.levels.host_program import HostProgram
from rack.levels.level import ConfiguredPorts, Executor, Output, Planner, Program
from rack.levels.operator import OperatorCommand
from rack.levels.ports import InputPort, WrittenPort
from rack.levels.references import find_class

OWN_OPERATOR = "own.operator"
LevelClass = type[Executor] | type[Planner] | type[HostProgram]


@dataclass(frozen=True)
class TaskPorts:
    """Class of a task or host board, and the mailboxes of its ports.

    Attributes:
        place: Entry of the task in the config.
        kind: Its class.
        inputs: Declarations of its inputs, keyed by port.
        outputs: Declarations of its outputs, keyed by port.
        reads: Mailbox of each input. For a port that reads several mailboxes, a dictionary from
            board to mailbox.
        exchange: The executor's `exchange` table, which determines the cycles in which ports are
            read, keyed by port.
        mistakes: Mistakes that prevent inputs from being connected.
        is_whole: False if some of the ports that the config adds are unknown because of mistakes.
    """

    place: TaskEntry
    kind: LevelClass
    inputs: Mapping[str, InputPort[Any, Any]]
    outputs: Mapping[str, WrittenPort[Any, Any]]
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
        """Whether the task is a bus adapter, which connects boards with host boards."""
        return issubclass(self.kind, Adapter) and self.kind.joins_sides

    @cached_property
    def sources(self) -> list[tuple[str, str]]:
        """Pairs of an input port and a mailbox that it reads."""
        return [
            (port, mailbox)
            for port, source in self.reads.items()
            for mailbox in list_mailboxes(source)
        ]

    @cached_property
    def writes(self) -> dict[str, str]:
        """Mailboxes that the task writes, by port."""
        return {port: f"{self.place.board}.{port}" for port in self.outputs}


def _connect_ports(
    config: RackConfig, place: TaskEntry, kind: LevelClass, types: Mapping[str, type[Message]]
) -> TaskPorts:
    """Connect the ports of a task or host board.

    Args:
        config: The config of the rack.
        place: Entry of the task in the config.
        kind: Class of the task.
        types: Message classes of the mailboxes that are known. A port that the config adds has the
            type of the mailbox that it reads.
    """
    mistakes: list[Mistake] = []
    reads = dict(_connect_inputs(config, place, kind.inputs, mistakes))
    exchange: Mapping[str, ExchangeConfig] = {}
    added_ports = ConfiguredPorts()
    if issubclass(kind, Executor):
        board = config.board[place.board]
        exchange = board.exchange
        added_ports = kind.build_ports(board.params, types)
    for port, entry in added_ports.inputs.items():
        entry.name = port
        reads[port] = entry.source
    outputs = {**kind.outputs, **added_ports.outputs}
    if exchange and added_ports.is_complete:
        # Do not replace an output of the class with this name. `check_exchange` reports it.
        outputs.setdefault(EXCHANGE_PORT, Output(build_exchange_message(reads)))
    inputs = {**kind.inputs, **added_ports.inputs}
    return TaskPorts(
        place, kind, inputs, outputs, reads, exchange, mistakes, added_ports.is_complete
    )


def _find_class(place: TaskEntry) -> LevelClass:
    """Return the class of a task or host board.

    Raises `LookupError` if the class is missing or its ports do not fit the role.
    """
    if place.role == "executor":
        return find_class(place.target, Executor)
    if place.role == "planner":
        planner = find_class(place.target, Planner)
        if not planner.outputs:
            raise LookupError("the class has no 'output', the port of its plan")
        return planner
    program = find_class(place.target, HostProgram)
    if many := [port for port, entry in program.inputs.items() if entry.many]:
        raise LookupError(f"port '{many[0]}' of a host board must not read several mailboxes")
    return program


def _connect_inputs(
    config: RackConfig,
    place: TaskEntry,
    inputs: Mapping[str, InputPort[Any, Any]],
    mistakes: list[Mistake],
) -> Iterator[tuple[str, Source]]:
    """Yield each connected input port with the mailbox or mailboxes that it reads.

    Args:
        config: The config of the rack.
        place: Entry of the task in the config.
        inputs: Declared inputs of the task, keyed by port.
        mistakes: List to which a mistake is added for each input that cannot be connected.
    """
    table = config.get_table(place)
    wired = config.get_rewired_ports(place)
    neighbours = {"own": (place.board,), "above": getattr(table, "above", ()), "below": table.below}
    others = config.board.keys() - {place.board}
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        boards = neighbours.get(start, (start,))
        key = f"{place.reads_key}.{port}" if port in wired else start
        mailboxes = wired.get(port, tuple(f"{board}.{rest}" for board in boards))
        port_text = f"port '{port}' of the {place.role}"
        if not mailboxes and not entry.optional:
            mistakes.append(
                Mistake(f"{place.table}.{start}", None, f"missing; {port_text} needs it")
            )
        elif len(mailboxes) > 1 and not entry.many:
            why = f"{port_text} reads one mailbox, not {len(mailboxes)}"
            mistakes.append(Mistake(f"{place.table}.{key}", wired.get(port, boards), why))
        elif key not in ("above", "below") or others.issuperset(boards):
            yield port, _group_by_board(mailboxes) if entry.many else mailboxes[0]


def _group_by_board(mailboxes: Sources) -> Source:
    """Return a dictionary from board to the mailbox that the board writes.

    If a board writes several of the mailboxes, each of them is keyed by its own name instead.
    """
    boards = [box.partition(".")[0] for box in mailboxes]
    return {
        board if boards.count(board) == 1 else box: box
        for board, box in zip(boards, mailboxes, strict=True)
    }


class Wiring:
    """Connected ports of all tasks and host boards.

    Attributes:
        config: The config of the rack.
        broken: Tables that were removed from the config because of mistakes, as in "board.servo".
        ports: Ports of every task and host board whose class can be used, in config order.
        unusable_classes: For every other task and host board, why its class cannot be used.
    """

    def __init__(self, config: RackConfig, broken: frozenset[str] = frozenset()) -> None:
        self.config = config
        self.broken = broken
        kinds: dict[TaskEntry, LevelClass] = {}
        self.unusable_classes: dict[TaskEntry, str] = {}
        for place in (*config.list_tasks(), *config.list_hosts()):
            try:
                kinds[place] = _find_class(place)
            except LookupError as error:
                self.unusable_classes[place] = str(error.args[0])
        types: dict[str, type[Message]] = {}
        while True:
            self.ports = {
                place: _connect_ports(config, place, kind, types) for place, kind in kinds.items()
            }
            written = {
                box: ports.outputs[port].message
                for ports in self.ports.values()
                for port, box in ports.writes.items()
            }
            # A port that the config adds may relay the messages of another added port, whose
            # message type must be known first. Repeat until no mailbox is added.
            if len(written) == len(types):
                return
            types = written

    @property
    def broken_boards(self) -> list[str]:
        """Names of the boards whose tables are broken."""
        return [name.removeprefix("board.") for name in self.broken if name.startswith("board.")]

    @property
    def tasks(self) -> list[TaskPorts]:
        """Ports of all tasks except host boards."""
        return [ports for ports in self.ports.values() if ports.place.role != "host"]

    @property
    def hosts(self) -> list[TaskPorts]:
        """Ports of the host boards."""
        return [ports for ports in self.ports.values() if ports.place.role == "host"]

    @cached_property
    def writers(self) -> dict[str, tuple[TaskPorts, WrittenPort[Any, Any]]]:
        """For each mailbox, the first task that writes it and the declaration of its output."""
        writers: dict[str, tuple[TaskPorts, WrittenPort[Any, Any]]] = {}
        for ports in self.ports.values():
            for port, mailbox in ports.writes.items():
                writers.setdefault(mailbox, (ports, ports.outputs[port]))
        return writers

    @cached_property
    def reading_ports(self) -> dict[str, list[tuple[TaskPorts, str]]]:
        """For each mailbox, the tasks that read it and their input ports."""
        reading: dict[str, list[tuple[TaskPorts, str]]] = {}
        for ports in self.ports.values():
            for port, mailbox in ports.sources:
                reading.setdefault(mailbox, []).append((ports, port))
        return reading

    @cached_property
    def operator_mailboxes(self) -> list[str]:
        """Mailboxes through which an operator commands levels."""
        is_any = names_scheduler(self.config)
        return [
            f"{board}.operator"
            for board, kind in find_executors(self.config).items()
            if is_any or has_operator_port(kind) or self.config.board[board].standby
        ]

    @cached_property
    def types(self) -> dict[str, MessageType]:
        """Message type of every mailbox."""
        written = {name: output.message.message_type for name, (_, output) in self.writers.items()}
        return written | dict.fromkeys(self.operator_mailboxes, OperatorCommand.message_type)

    @cached_property
    def mailboxes_from_host(self) -> set[str]:
        """Mailboxes that host boards write."""
        return {mailbox for ports in self.hosts for mailbox in ports.writes.values()}

    @cached_property
    def passed_mailboxes(self) -> dict[str, str]:
        """For each mailbox into which a bus adapter copies messages, the mailbox that it copies."""
        return {
            f"{ports.place.board}.{port}": source
            for ports in self.tasks
            if ports.joins_sides
            for port, source in ports.sources
        }

    @cached_property
    def mailboxes_to_host(self) -> set[str]:
        """Mailboxes that bus adapters write for host boards."""
        passed = self.passed_mailboxes
        return {box for box, source in passed.items() if source not in self.mailboxes_from_host}

    @property
    def host_side_mailboxes(self) -> set[str]:
        """Mailboxes that host boards write or that bus adapters write for host boards."""
        return self.mailboxes_from_host | self.mailboxes_to_host

    @cached_property
    def periods(self) -> dict[str, int]:
        """Periods of the boards in ticks. Boards with an invalid rate are left out."""
        periods: dict[str, int] = {}
        for name in self.config.board if "clock" not in self.broken else ():
            with suppress(ClockError):
                periods[name] = self.config.find_period(name)
        return periods

    @cached_property
    def unknown_boards(self) -> set[str]:
        """Boards some of whose mailboxes are unknown because of mistakes.

        If a port reads an unknown mailbox of such a board, this is not reported as another mistake.
        """
        boards = {place.board for place in self.unusable_classes}
        boards |= {ports.place.board for ports in self.ports.values() if not ports.is_whole}
        boards |= {place.removeprefix("board.").removeprefix("host.") for place in self.broken}
        is_lan_unknown = "adapter" in self.broken or is_adapter_name_taken(self.config)
        return boards | {LAN} if is_lan_unknown else boards

    @property
    def params(self) -> Iterable[tuple[str, type[BaseModel]]]:
        """Distinct pairs of a table such as "board.servo" and the model of its parameters."""
        return dict.fromkeys(
            (place.table, ports.kind.params)
            for place, ports in self.ports.items()
            if ports.kind.params is not None
        )

    @property
    def programs(self) -> Iterable[type[Program]]:
        """Distinct models of the programs that levels read from `[task]`."""
        return dict.fromkeys(
            p.kind.program for p in self.ports.values() if p.kind.program is not None
        )

    def is_known(self, mailbox: str) -> bool:
        """Return True if a mailbox exists, or may exist because its board has mistakes."""
        return mailbox in self.types or mailbox.partition(".")[0] in self.unknown_boards

    def list_readers(self, mailbox: str) -> tuple[str, ...]:
        """Return the names of the tasks and host boards that read a mailbox."""
        return tuple(dict.fromkeys(ports.task for ports, _ in self.reading_ports.get(mailbox, ())))

    def belongs_to_network_adapter(self, name: str) -> bool:
        """Return True for the network adapter's board and for the mailboxes that it writes.

        Args:
            name: Name of a board or of a mailbox.
        """
        return self.config.adapter.lan is not None and name.partition(".")[0] == LAN

    def find_protocol(self, mailbox: str) -> Protocol:
        """Return the protocol of a mailbox.

        It is time-slice for mailboxes that host boards read, and queue for queues and for mailboxes
        that host boards write. For all others it is the protocol in the config, unless the clock or
        the network adapter writes the mailbox and cannot use this protocol.
        """
        if mailbox in self.mailboxes_to_host:
            # Host boards always read the newest message at once.
            return "time-slice"
        if mailbox in self.mailboxes_from_host or (
            mailbox in self.writers and self.writers[mailbox][1].queued
        ):
            return "queue"
        protocol = self.config.protocol.mailbox.get(mailbox, self.config.protocol.default)
        if protocol == "interrupt" and (
            mailbox in self.operator_mailboxes or self.belongs_to_network_adapter(mailbox)
        ):
            # Messages of the clock and of the network adapter do not interrupt boards.
            return "time-slice"
        # The clock writes the operator mailboxes and must not wait for a reader that holds a lock.
        return (
            "double-buffer"
            if protocol == "lock" and mailbox in self.operator_mailboxes
            else protocol
        )


def find_executors(config: RackConfig) -> dict[str, type[Executor]]:
    """Return the executor class of each board. Boards whose class is missing are left out."""
    classes: dict[str, type[Executor]] = {}
    for name, board in config.board.items():
        with suppress(LookupError):
            classes[name] = find_class(board.executor, Executor)
    return classes


def has_operator_port(executor: type[Executor]) -> bool:
    """Return True if a level has a port for operator commands."""
    return any(port.source == OWN_OPERATOR for port in executor.inputs.values())


def is_adapter_name_taken(config: RackConfig) -> bool:
    """Return True if another board has the name of the network adapter's board."""
    # Broken tables of boards are removed, so the adapter's board may be missing.
    return (
        config.adapter.lan is not None
        and LAN in config.board
        and config.board[LAN] != config.adapter.lan.build_board()
    )
