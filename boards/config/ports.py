"""The ports of all tasks and the mailboxes to which they are connected.

A port's source is a mailbox, or is relative to its board: "above.command", "below.status", "own.plan". The config may
connect a port to another mailbox.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rack.backplane.layout import Role
from rack.backplane.message import MessageType
from rack.boards.classes import find_class
from rack.boards.config.schema import RackConfig, TaskPlace
from rack.boards.errors import Mistake
from rack.levels.level import Executor, Input, Output, Planner


@dataclass(frozen=True)
class TaskPorts:
    """A task's class, and the mailbox of each port.

    `reads` and `writes` map ports to mailboxes, `inputs` to message types, `outputs` to types and the cycles from
    message to message.
    """

    place: TaskPlace
    kind: type[Executor] | type[Planner]
    inputs: Mapping[str, MessageType]
    outputs: Mapping[str, Output]
    reads: Mapping[str, str]
    writes: Mapping[str, str]

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.place.name


def all_ports(config: RackConfig, mistakes: list[Mistake]) -> list[TaskPorts]:
    """Return the ports of every task whose class is found; add all mistakes to `mistakes`."""
    wired = [_wired(config, place, mistakes) for place in config.tasks()]
    return [ports for ports in wired if ports is not None]


def reference(config: RackConfig, place: TaskPlace) -> str:
    """Return the class that the config names for a task, as "package.module:Class"."""
    board = config.board[place.board]
    return board.executor if place.role == "executor" else board.planner or ""


def _wired(config: RackConfig, place: TaskPlace, mistakes: list[Mistake]) -> TaskPorts | None:
    wanted = reference(config, place)
    try:
        kind, outputs = _class(wanted, place.role)
    except LookupError as error:
        mistakes.append(Mistake(f"board.{place.board}.{place.role}", wanted, str(error.args[0])))
        return None
    return TaskPorts(
        place=place,
        kind=kind,
        inputs={port: entry.type for port, entry in kind.inputs.items()},
        outputs=outputs,
        reads=dict(_sources(config, place, kind.inputs, mistakes)),
        writes={port: f"{place.board}.{port}" for port in outputs},
    )


def _class(wanted: str, role: Role) -> tuple[type[Executor] | type[Planner], Mapping[str, Output]]:
    if role == "executor":
        executor = find_class(wanted, Executor)
        given = executor.outputs.items()
        return executor, {port: kind if isinstance(kind, Output) else Output(kind, 1) for port, kind in given}
    planner = find_class(wanted, Planner)
    if not isinstance(getattr(planner, "output", None), MessageType):
        raise LookupError("the class has no 'output', the message type of its plan")
    return planner, {"plan": Output(planner.output, 1)}


def _sources(
    config: RackConfig, place: TaskPlace, inputs: Mapping[str, Input], mistakes: list[Mistake]
) -> Iterator[tuple[str, str]]:
    """Yield port and mailbox for every port that has a mailbox."""
    name, role, table = place.board, place.role, config.board[place.board]
    key, wired = ("reads", table.reads) if role == "executor" else ("planner_reads", table.planner_reads)
    neighbours = {"own": name, "above": table.above, "below": table.below}
    for port in [p for p in wired if p not in inputs]:
        why = f"the {role} has no such port; ports: {', '.join(inputs) or 'none'}"
        mistakes.append(Mistake(f"board.{name}.{key}.{port}", wired[port], why))
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        neighbour = neighbours.get(start, start)
        if port in wired:
            yield port, wired[port]
        elif neighbour is not None:
            # A neighbour that does not exist is reported by the rules.
            if start not in ("above", "below") or neighbour in config.board.keys() - {name}:
                yield port, f"{neighbour}.{rest}"
        else:
            mistakes.append(Mistake(f"board.{name}.{start}", None, f"missing; port '{port}' of the {role} needs it"))
