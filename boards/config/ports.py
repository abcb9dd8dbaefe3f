"""The ports of all tasks and the mailboxes to which they are connected.

A port's source is a mailbox, or is relative to its board: "above.command", "below.status", "own.plan". The config may
connect a port to another mailbox.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from rack.backplane.layout import Role
from rack.backplane.message import MessageType
from rack.boards.classes import find_class
from rack.boards.config.rules.protocols import exchange_mistakes
from rack.boards.config.schema import RackConfig, Sources, TaskPlace
from rack.boards.errors import Mistake
from rack.boards.exchange import EXCHANGE, exchange_message
from rack.boards.wiring import Source, mailboxes_of
from rack.levels.host_program import HostProgram
from rack.levels.level import Executor, Input, Output, Planner


@dataclass(frozen=True)
class TaskPorts:
    """The class of a task or host board, and the mailbox of each port.

    `reads` holds a mailbox by port or, for a port that reads many, a dict of mailboxes by board; `writes` a mailbox by
    port, `inputs` and `outputs` the declarations of the ports; not `is_whole` if mistakes keep some unknown.
    """

    place: TaskPlace
    kind: type[Executor] | type[Planner] | type[HostProgram]
    inputs: Mapping[str, Input]
    outputs: Mapping[str, Output]
    reads: Mapping[str, Source]
    writes: Mapping[str, str]
    is_whole: bool = True

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.place.name

    @property
    def sources(self) -> list[tuple[str, str]]:
        """Port and mailbox of everything that the task reads."""
        return [(port, mailbox) for port, source in self.reads.items() for mailbox in mailboxes_of(source)]

    def rests_on(self, output: str) -> tuple[str, ...]:
        """Return the mailboxes on whose information an output rests."""
        return mailboxes_of(self.reads.get(self.outputs[output].rests_on or output, {}))


def all_ports(config: RackConfig, mistakes: list[Mistake]) -> list[TaskPorts]:
    """Return the ports of every task and host board whose class is found; add all mistakes to `mistakes`."""
    wired = [_wired(config, place, mistakes) for place in (*config.tasks(), *config.hosts())]
    found = [ports for ports in wired if ports is not None]
    whole, types, before = found, _types(found), -1
    # What one board makes another may pass on.
    while len(types) != before:
        before, whole = len(types), [_with_made_ports(config, ports, types) for ports in found]
        types = _types(whole)
    return [_with_exchange(config, ports, mistakes) for ports in whole]


def _types(found: list[TaskPorts]) -> dict[str, MessageType]:
    return {box: ports.outputs[port].type for ports in found for port, box in ports.writes.items()}


def _with_made_ports(config: RackConfig, ports: TaskPorts, types: Mapping[str, MessageType]) -> TaskPorts:
    """Add the ports that the config makes: their types may be those of other mailboxes."""
    if not issubclass(ports.kind, Executor):
        return ports
    board = ports.place.board
    made = ports.kind.made_ports(config.board[board].params, types)
    return replace(
        ports,
        inputs={**ports.inputs, **made.inputs},
        outputs={**ports.outputs, **made.outputs},
        reads={**ports.reads, **{port: entry.source for port, entry in made.inputs.items()}},
        writes={**ports.writes, **{port: f"{board}.{port}" for port in made.outputs}},
        is_whole=made.is_whole,
    )


def _with_exchange(config: RackConfig, ports: TaskPorts, mistakes: list[Mistake]) -> TaskPorts:
    """Add the mailbox of the exchange to a board whose config has one."""
    board = ports.place.board
    if ports.place.role != "executor" or not config.board[board].exchange or not ports.is_whole:
        return ports
    mistakes += exchange_mistakes(config, board, ports.inputs)
    if EXCHANGE in ports.outputs:
        why = "the executor writes a mailbox of that name itself; rename its output"
        mistakes.append(Mistake(f"board.{board}.exchange", None, why))
    outputs = {**ports.outputs, EXCHANGE: Output(exchange_message(ports.reads))}
    return replace(ports, outputs=outputs, writes={**ports.writes, EXCHANGE: f"{board}.{EXCHANGE}"})


def reference(config: RackConfig, place: TaskPlace) -> str:
    """Return the class that the config names for a task or host board, as "package.module:Class"."""
    if place.role == "host":
        return config.host[place.board].program
    board = config.board[place.board]
    return board.executor if place.role == "executor" else board.planner or ""


def _wired(config: RackConfig, place: TaskPlace, mistakes: list[Mistake]) -> TaskPorts | None:
    wanted = reference(config, place)
    try:
        kind, outputs = _class(wanted, place.role)
    except LookupError as error:
        key = "program" if place.role == "host" else place.role
        mistakes.append(Mistake(f"{table_of(place)}.{key}", wanted, str(error.args[0])))
        return None
    for port, entry in outputs.items():
        if entry.rests_on and entry.rests_on not in kind.inputs:
            why = f"its output '{port}' rests on '{entry.rests_on}'; inputs: {', '.join(kind.inputs) or 'none'}"
            mistakes.append(Mistake(f"board.{place.board}.{place.role}", wanted, why))
    return TaskPorts(
        place=place,
        kind=kind,
        inputs=kind.inputs,
        outputs=outputs,
        reads=dict(_sources(config, place, kind.inputs, mistakes)),
        writes={port: f"{place.board}.{port}" for port in outputs},
    )


def table_of(place: TaskPlace) -> str:
    """Return the table of a task's board, or of a host board, as in "board.servo"."""
    return f"{'host' if place.role == 'host' else 'board'}.{place.board}"


def _class(wanted: str, role: Role) -> tuple[type[Executor] | type[Planner] | type[HostProgram], Mapping[str, Output]]:
    if role == "host":
        program = find_class(wanted, HostProgram)
        if many := [port for port, entry in program.inputs.items() if entry.many]:
            raise LookupError(f"port '{many[0]}' reads many mailboxes; permitted on the host side: one")
        return program, {port: Output(kind) for port, kind in program.outputs.items()}
    if role == "executor":
        executor = find_class(wanted, Executor)
        given = executor.outputs.items()
        return executor, {port: kind if isinstance(kind, Output) else Output(kind) for port, kind in given}
    planner = find_class(wanted, Planner)
    if not isinstance(output := getattr(planner, "output", None), MessageType | Output):
        raise LookupError("the class has no 'output', the message type of its plan")
    return planner, {"plan": output if isinstance(output, Output) else Output(output)}


def _sources(
    config: RackConfig, place: TaskPlace, inputs: Mapping[str, Input], mistakes: list[Mistake]
) -> Iterator[tuple[str, Source]]:
    """Yield port and mailbox, or mailboxes by board, for every port that has one."""
    name, role = place.board, place.role
    key, wired, above, below = _own_wiring(config, place)
    neighbours = {"own": (name,), "above": above, "below": below}
    for port in [p for p in wired if p not in inputs]:
        why = f"the {role} has no such port; ports: {', '.join(inputs) or 'none'}"
        mistakes.append(Mistake(f"{table_of(place)}.{key}.{port}", list(wired[port]), why))
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        boards = neighbours.get(start, (start,))
        found = wired.get(port, tuple(f"{board}.{rest}" for board in boards))
        at, given = (f"{key}.{port}", list(found)) if port in wired else (start, list(boards))
        if not found and entry.many and entry.optional:
            yield port, {}
        elif not found:
            why = f"missing; port '{port}' of the {role} needs it"
            mistakes.append(Mistake(f"{table_of(place)}.{start}", None, why))
        elif not entry.many and len(found) > 1:
            why = f"port '{port}' of the {role} reads one mailbox, not {len(found)}"
            mistakes.append(Mistake(f"{table_of(place)}.{at}", given, why))
        elif port in wired or start not in ("above", "below") or {*boards} <= config.board.keys() - {name}:
            # A neighbour that does not exist is reported by the rules.
            yield port, _by_board(found) if entry.many else found[0]


def _by_board(mailboxes: Sources) -> dict[str, str]:
    """Return the mailboxes of a port that reads many, by board, or by their names if one board writes several."""
    boards = [box.partition(".")[0] for box in mailboxes]
    return {board if boards.count(board) == 1 else box: box for board, box in zip(boards, mailboxes, strict=True)}


def _own_wiring(config: RackConfig, place: TaskPlace) -> tuple[str, Mapping[str, Sources], Sources, Sources]:
    """Return the key under which a config rewires ports, what it holds, and the boards above and below."""
    if place.role == "host":
        host = config.host[place.board]
        return "reads", host.reads, (), host.below
    board = config.board[place.board]
    if place.role == "executor":
        return "reads", board.reads, board.above, board.below
    return "planner_reads", board.planner_reads, board.above, board.below
