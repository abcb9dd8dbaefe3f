"""From config to layout: every mailbox and every task of a rack, as plain data for its segment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pydantic import ValidationError

from rack.backplane.address_map import CLOCK, AddressMap
from rack.backplane.errors import MailboxError
from rack.backplane.layout import Layout, MailboxSpec, Protocol, TaskSpec, depth_for
from rack.backplane.message import MessageType
from rack.boards.config.cell import cell_sizes
from rack.boards.config.commands import command_mistakes, command_places, commandable
from rack.boards.config.cores import obtained_core
from rack.boards.config.faults import fault_mistakes, places
from rack.boards.config.fields import field_specs
from rack.boards.config.ports import TaskPorts, all_ports
from rack.boards.config.rules import mistakes_in
from rack.boards.config.schema import BoardConfig, RackConfig
from rack.boards.config.schema_mistakes import mistakes_of
from rack.boards.errors import ConfigError, Mistake
from rack.boards.faults.config import FaultConfig
from rack.boards.operating.config import CommandConfig
from rack.levels.errors import ProgramError
from rack.levels.operator import OPERATOR_COMMAND

OPERATOR_DEPTH = 128
"""Slots of an operator's mailbox: commands come now and then."""
LARGEST_BYTES = 2**30
"""Size of a rack's segment, at most."""
HISTORY_S = 2.0
"""Simulated time that mailboxes and trace rings keep for a recorder: real-time boards may starve it for 1 s."""


def wire(config: RackConfig) -> Layout:
    """Return the layout of a rack. Raises `ConfigError` with every mistake."""
    mistakes, layout = judged(config, places(config), command_places(config))
    if layout is None or mistakes:
        raise ConfigError(mistakes)
    return layout


def judged(
    config: RackConfig,
    faults: Iterable[tuple[str, FaultConfig]],
    commands: Iterable[tuple[str, CommandConfig]],
    broken: frozenset[str] = frozenset(),
) -> tuple[list[Mistake], Layout | None]:
    """Return every mistake of a config, its wiring and its cell, and the layout where there is none.

    `broken` names tables that the config lacks, as their mistakes are known: nothing that depends on them is judged.
    """
    mistakes = mistakes_in(config, broken)
    tables = {mistake.place.partition(".")[0] for mistake in mistakes} | broken
    wiring = Wiring(config, broken)
    mistakes += wiring.mistakes
    sizes = cell_sizes(config, mistakes, is_whole=not tables & {"robot", "scene"})
    if not mistakes and not broken:
        mistakes += wiring.check_sizes(sizes)
    layout = None if mistakes or broken else wiring.layout(sizes)
    if layout is not None:
        mistakes += too_large(layout)
    untold = frozenset(place.removeprefix("board.") for place in broken if place.startswith("board."))
    mistakes += fault_mistakes(faults, config, layout if not mistakes else None, untold)
    mistakes += command_mistakes(commands, config, untold)
    return mistakes, layout


def too_large(layout: Layout) -> list[Mistake]:
    """Return a mistake for the largest part of a segment that no machine should be asked for."""
    whole = AddressMap(layout).size
    if whole <= LARGEST_BYTES:
        return []
    box = max(layout.mailboxes, key=lambda mailbox: mailbox.depth * mailbox.size)
    why = f"keeps {box.depth} messages for its slowest reader, and the segment has {whole} bytes"
    return [Mistake(f"mailbox {box.name}", None, f"{why}; permitted: {LARGEST_BYTES}; shorten cycles or within_cycles")]


class Wiring:
    """The ports of all tasks brought together: who writes each mailbox, and who reads it."""

    def __init__(self, config: RackConfig, broken: frozenset[str] = frozenset()) -> None:
        self.config = config
        self.mistakes: list[Mistake] = []
        self._tasks = all_ports(config, self.mistakes)
        # Mailboxes of a board that has mistakes of its own cannot be told: no mistake follows from that.
        found = {ports.task for ports in self._tasks}
        lacking = {name for name, board in config.board.items() if name not in found}
        lacking |= {n for n, b in config.board.items() if b.planner is not None and f"{n}.planner" not in found}
        self._untold = lacking | {place.removeprefix("board.") for place in broken}
        self._writers: dict[str, tuple[TaskPorts, MessageType]] = {}
        for ports in self._tasks:
            self._add_writer(ports)
        self._operated = {f"{board}.operator": OPERATOR_COMMAND for board in commandable(config)}
        self._check_operated()
        for ports in self._tasks:
            self._check_reads(ports)
        self._check_rest()
        self._check_params()
        if "robot" not in broken and "scene" not in broken:
            self._check_program()

    def _add_writer(self, ports: TaskPorts) -> None:
        for port, mailbox in ports.writes.items():
            if mailbox in self._writers:
                first = self._writers[mailbox][0].task
                self.mistakes.append(Mistake(f"mailbox {mailbox}", ports.task, f"has a writer already: {first}"))
            else:
                self._writers[mailbox] = ports, ports.outputs[port]

    def _check_operated(self) -> None:
        """The clock writes an operator's mailbox, and must never wait."""
        for mailbox in self._operated:
            if mailbox in self._writers:
                first = self._writers[mailbox][0].task
                self.mistakes.append(Mistake(f"mailbox {mailbox}", first, "is an operator's; the clock writes it"))
            if self.config.protocol.mailbox.get(mailbox) == "lock":
                why = "the clock writes it, and waits for nobody; permitted: time-slice, double-buffer"
                self.mistakes.append(Mistake(f"protocol.mailbox.{mailbox}", "lock", why))

    def _check_reads(self, ports: TaskPorts) -> None:
        key = "reads" if ports.role == "executor" else "planner_reads"
        for port, mailbox in ports.reads.items():
            place, wanted = f"board.{ports.board}.{key}.{port}", ports.inputs[port]
            if mailbox not in self._writers and mailbox not in self._operated:
                if mailbox.partition(".")[0] not in self._untold:
                    self.mistakes.append(Mistake(place, mailbox, f"nobody writes it; mailboxes: {self._names()}"))
            elif (found := self._kind(mailbox)) != wanted:
                why = f"carries {found.name} {found.version}; the port wants {wanted.name} {wanted.version}"
                self.mistakes.append(Mistake(place, mailbox, why))

    def _check_rest(self) -> None:
        for mailbox in self.config.protocol.mailbox:
            known = mailbox in self._writers or mailbox in self._operated
            if not known and mailbox.partition(".")[0] not in self._untold:
                self.mistakes.append(
                    Mistake(f"protocol.mailbox.{mailbox}", None, f"no such mailbox; mailboxes: {self._names()}")
                )
        for name, board in self.config.board.items():
            if board.ends_run and name not in self._untold and f"{name}.status" not in self._writers:
                self.mistakes.append(Mistake(f"board.{name}.ends_run", True, "its executor writes no status"))

    def _check_params(self) -> None:
        """Check the parameters of a board against what its executor's and planner's classes declare."""
        kinds = [(ports.board, ports.kind.params) for ports in self._tasks if ports.kind.params is not None]
        for board, kind in dict.fromkeys(kinds):
            params = self.config.board[board].params
            try:
                kind.model_validate(params)
            except ValidationError as error:
                self.mistakes += mistakes_of(error, kind, params, f"board.{board}.params")

    def _check_program(self) -> None:
        """Check the program of the project's own task level; a user's own reads its `[task]` itself."""
        robot = self.config.robot
        if robot is None or not any(ports.kind.__module__.startswith("rack.levels.task") for ports in self._tasks):
            return
        from rack.levels.task import read_program  # imported by its board's class already

        try:
            read_program(self.config.task, robot, self.config.scene)
        except ProgramError as error:
            told = (line.partition(": ") for line in str(error).splitlines())
            self.mistakes += [Mistake(place, None, why) for place, _, why in told]

    def _kind(self, mailbox: str) -> MessageType:
        return self._operated[mailbox] if mailbox in self._operated else self._writers[mailbox][1]

    def _names(self) -> str:
        return ", ".join([*self._writers, *self._operated])

    def check_sizes(self, sizes: Mapping[str, int]) -> list[Mistake]:
        """Return a mistake for every message with a size that the rack does not know."""
        found = []
        for mailbox, (ports, kind) in self._writers.items():
            try:
                kind.dtype(sizes)
            except MailboxError as error:
                found.append(Mistake(f"mailbox {mailbox}", ports.task, str(error)))
        return found

    def layout(self, sizes: Mapping[str, int]) -> Layout:
        """Return the layout; there are no mistakes."""
        tasks = tuple(self._task(ports) for ports in self._tasks)
        by_name = {task.name: task for task in tasks}
        mailboxes = [self._mailbox(mailbox, by_name, sizes) for mailbox in self._writers]
        mailboxes += [self._operators_mailbox(mailbox, kind) for mailbox, kind in self._operated.items()]
        return Layout(self.config.name, self.config.clock_ns, tasks, tuple(mailboxes))

    def _task(self, ports: TaskPorts) -> TaskSpec:
        board, every = self.config.board[ports.board], self.config.every(ports.board)
        slot, core, priority = _place(board) if ports.role == "planner" else (board.slot, board.core, board.priority)
        return TaskSpec(
            name=ports.task,
            board=ports.board,
            role=ports.role,
            slot=slot,
            core=obtained_core(core),
            priority=priority,
            every=every,
            within_cycles=board.within_cycles if ports.role == "planner" else 1,
            depth=depth_for(self._history_ticks, every),
        )

    @property
    def _history_ticks(self) -> int:
        return round(HISTORY_S * 1e9 / self.config.clock_ns)

    def _mailbox(self, name: str, tasks: Mapping[str, TaskSpec], sizes: Mapping[str, int]) -> MailboxSpec:
        ports, kind = self._writers[name]
        writer = tasks[ports.task]
        readers = [tasks[reader] for reader in self._readers(name)]
        delay = writer.every * writer.within_cycles
        # A reader may still read, at the end of its own slice, what was visible at its start.
        slowest = max((reader.every * reader.within_cycles for reader in readers), default=0)
        return MailboxSpec(
            name=name,
            writer=writer.name,
            readers=tuple(reader.name for reader in readers),
            protocol=self._protocol(name),
            every=writer.every,
            delay=delay,
            depth=depth_for(max(slowest + delay, self._history_ticks), writer.every),
            message=kind.name,
            version=kind.version,
            size=kind.dtype(sizes).itemsize,
            fields=field_specs(kind, sizes),
        )

    def _operators_mailbox(self, name: str, kind: MessageType) -> MailboxSpec:
        """Return the mailbox in which the clock gives an operator's commands to a level."""
        protocol = self._protocol(name)
        return MailboxSpec(
            name=name,
            writer=CLOCK,
            readers=self._readers(name),
            # With a lock the clock would wait for its readers.
            protocol="double-buffer" if protocol == "lock" else protocol,
            every=1,
            delay=1,
            depth=OPERATOR_DEPTH,
            message=kind.name,
            version=kind.version,
            size=kind.dtype({}).itemsize,
            fields=field_specs(kind, {}),
        )

    def _readers(self, mailbox: str) -> tuple[str, ...]:
        return tuple(ports.task for ports in self._tasks if mailbox in ports.reads.values())

    def _protocol(self, mailbox: str) -> Protocol:
        return self.config.protocol.mailbox.get(mailbox, self.config.protocol.default)


def _place(board: BoardConfig) -> tuple[int, int, int]:
    """Return slot, core and priority of a board's planner."""
    slot = board.slot if board.planner_slot is None else board.planner_slot
    core = board.core if board.planner_core is None else board.planner_core
    return slot, core, board.planner_priority
