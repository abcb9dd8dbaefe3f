"""The ports of every task and the mailboxes they are wired to.

A port's source is a mailbox, or relative to its board: "above.command", "below.status", "own.plan".
The config may wire a port elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rack.backplane.layout import Role
from rack.backplane.message import MessageType
from rack.boards.config.classes import find_class
from rack.boards.config.schema import RackConfig
from rack.boards.errors import ConfigError, Mistake
from rack.levels.level import Executor, Input, Planner


@dataclass(frozen=True)
class TaskPorts:
    """The executor or planner of a board: its class, and a mailbox for every port.

    `reads` and `writes` map ports to mailboxes, `inputs` and `outputs` to message types.
    """

    board: str
    role: Role
    kind: type[Executor] | type[Planner]
    inputs: Mapping[str, MessageType]
    outputs: Mapping[str, MessageType]
    reads: Mapping[str, str]
    writes: Mapping[str, str]

    @property
    def task(self) -> str:
        """Name of the task: the board's, with ".planner" for its planner."""
        return self.board if self.role == "executor" else f"{self.board}.planner"


def task_ports(config: RackConfig, board: str, role: Role) -> TaskPorts:
    """Return the ports of a board's executor or planner. Raises `ConfigError`."""
    mistakes: list[Mistake] = []
    ports = _wired(config, board, role, mistakes)
    if ports is None or mistakes:
        raise ConfigError(mistakes)
    return ports


def all_ports(config: RackConfig, mistakes: list[Mistake]) -> list[TaskPorts]:
    """Return the ports of every task whose class can be had; add what is wrong to `mistakes`."""
    wired = [_wired(config, board, role, mistakes) for board, role in _roles(config)]
    return [ports for ports in wired if ports is not None]


def _roles(config: RackConfig) -> Iterator[tuple[str, Role]]:
    for name, table in config.board.items():
        yield name, "executor"
        if table.planner is not None:
            yield name, "planner"


def _wired(config: RackConfig, board: str, role: Role, mistakes: list[Mistake]) -> TaskPorts | None:
    table = config.board[board]
    try:
        kind, outputs = _class(table.executor if role == "executor" else table.planner or "", role)
    except LookupError as error:
        value = table.executor if role == "executor" else table.planner
        mistakes.append(Mistake(f"board.{board}.{role}", value, str(error.args[0])))
        return None
    return TaskPorts(
        board=board,
        role=role,
        kind=kind,
        inputs={port: entry.type for port, entry in kind.inputs.items()},
        outputs=outputs,
        reads=dict(_sources(config, board, role, kind.inputs, mistakes)),
        writes={port: f"{board}.{port}" for port in outputs},
    )


def _class(reference: str, role: Role) -> tuple[type[Executor] | type[Planner], Mapping[str, MessageType]]:
    if role == "executor":
        executor = find_class(reference, Executor)
        return executor, executor.outputs
    planner = find_class(reference, Planner)
    if not isinstance(getattr(planner, "output", None), MessageType):
        raise LookupError("the class has no 'output', the message type of its plan")
    return planner, {"plan": planner.output}


def _sources(
    config: RackConfig, board: str, role: Role, inputs: Mapping[str, Input], mistakes: list[Mistake]
) -> Iterator[tuple[str, str]]:
    """Yield port and mailbox for every port that has one."""
    table = config.board[board]
    key, wired = ("reads", table.reads) if role == "executor" else ("planner_reads", table.planner_reads)
    neighbours = {"own": board, "above": table.above, "below": table.below}
    for port in [p for p in wired if p not in inputs]:
        why = f"the {role} has no such port; ports: {', '.join(inputs) or 'none'}"
        mistakes.append(Mistake(f"board.{board}.{key}.{port}", wired[port], why))
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        neighbour = neighbours.get(start, start)
        if port in wired:
            yield port, wired[port]
        elif neighbour is not None:
            # A neighbour that is none is a mistake of its own, found by the rules.
            if start not in ("above", "below") or neighbour in config.board.keys() - {board}:
                yield port, f"{neighbour}.{rest}"
        else:
            why = f"missing; the {role}'s port '{port}' reads '{entry.source}'"
            mistakes.append(Mistake(f"board.{board}.{start}", None, why))
