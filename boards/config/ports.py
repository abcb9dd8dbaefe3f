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
from rack.boards.wiring import Source, mailboxes_of
from rack.levels.level import Executor, Input, Output, Planner


@dataclass(frozen=True)
class TaskPorts:
    """A task's class, and the mailbox of each port.

    `reads` holds a mailbox by port or, for a port that reads many, a dict of mailboxes by board; `writes` a mailbox by
    port, `inputs` and `outputs` the declarations of the ports.
    """

    place: TaskPlace
    kind: type[Executor] | type[Planner]
    inputs: Mapping[str, Input]
    outputs: Mapping[str, Output]
    reads: Mapping[str, Source]
    writes: Mapping[str, str]

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


def _class(wanted: str, role: Role) -> tuple[type[Executor] | type[Planner], Mapping[str, Output]]:
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
    name, role, table = place.board, place.role, config.board[place.board]
    key, wired = ("reads", table.reads) if role == "executor" else ("planner_reads", table.planner_reads)
    neighbours = {"own": (name,), "above": table.above, "below": table.below}
    for port in [p for p in wired if p not in inputs]:
        why = f"the {role} has no such port; ports: {', '.join(inputs) or 'none'}"
        mistakes.append(Mistake(f"board.{name}.{key}.{port}", list(wired[port]), why))
    for port, entry in inputs.items():
        start, _, rest = entry.source.partition(".")
        boards = neighbours.get(start, (start,))
        found = wired.get(port, tuple(f"{board}.{rest}" for board in boards))
        at, given = (f"{key}.{port}", list(found)) if port in wired else (start, list(boards))
        if not found and entry.many and entry.optional:
            yield port, {}
        elif not found:
            mistakes.append(Mistake(f"board.{name}.{start}", None, f"missing; port '{port}' of the {role} needs it"))
        elif not entry.many and len(found) > 1:
            why = f"port '{port}' of the {role} reads one mailbox, not {len(found)}"
            mistakes.append(Mistake(f"board.{name}.{at}", given, why))
        elif port in wired or start not in ("above", "below") or {*boards} <= config.board.keys() - {name}:
            # A neighbour that does not exist is reported by the rules.
            yield port, {box.partition(".")[0]: box for box in found} if entry.many else found[0]
