"""What faults must agree on with the rack that they are injected into: every mistake of every one, at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from rack.backplane.address_map import CLOCK, FAULT_ENTRIES
from rack.backplane.layout import Layout, Role
from rack.boards.classes import find_class
from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake
from rack.boards.faults.condition import condition
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kinds import KINDS, NUMBERS, Kind, Parameter
from rack.levels.level import Executor

FOR_THE_CLOCK = tuple(kind.name for kind in KINDS if kind.where == "clock" or kind.name == "kill")
"""Kinds that the system controller can have."""
WRITERS = ("writer", "bus", "lock")
"""Where a kind strikes that is about mailboxes."""
ROLES: Mapping[str, Role] = {"overrun": "executor", "planner-slow": "planner"}


@dataclass(frozen=True)
class FaultRules:
    """The rules for one fault at `place`. Without a layout, what needs one is not looked at.

    `untold` are boards whose own mistakes are told already.
    """

    place: str
    fault: FaultConfig
    config: RackConfig
    layout: Layout | None = None
    untold: frozenset[str] = frozenset()

    def mistakes(self) -> Iterator[Mistake]:
        """Yield everything wrong with the fault."""
        yield from self._once_each()
        kind = KINDS[NUMBERS[self.fault.kind]] if self.fault.kind in NUMBERS else None
        if kind is None:
            yield self._mistake("kind", f"no such kind; kinds: {', '.join(NUMBERS)}")
        else:
            yield from self._of_kind(kind)
        tasks = self._tasks()
        if self.fault.board != CLOCK and self.fault.board not in tasks:
            if self.fault.board.partition(".")[0] not in self.untold:
                yield self._mistake("board", f"no such task; tasks: {', '.join([*tasks, CLOCK])}")
        elif kind is not None:
            yield from self._fit(kind, tasks)
        if self.layout is not None and self.fault.when is not None:
            try:
                condition(self.fault.when, self.layout)
            except LookupError as error:
                yield self._mistake("when", str(error.args[0]))

    def _once_each(self) -> Iterator[Mistake]:
        """Begin and end are each given in one way."""
        for keys in (("tick", "at", "when"), ("for", "cycles")):
            given = [key for key in keys if self._value(key) is not None]
            for key in given[1:]:
                yield self._mistake(key, f"{given[0]} is given as well; permitted: one of {', '.join(keys)}")

    def _of_kind(self, kind: Kind) -> Iterator[Mistake]:
        if kind.realtime and self.config.clock.mode == "lockstep":
            why = f"{kind.name} needs real time: in lockstep time waits for everybody; run without --lockstep"
            yield self._mistake("kind", why)
        for key in ("for", "cycles") if kind.once else ():
            if self._value(key) is not None:
                yield self._mistake(key, f"{kind.name} strikes once, it does not last; leave it out")
        for key in ("tick", "at", "when") if kind.where == "start" else ():
            if self._value(key) is not None:
                yield self._mistake(key, f"{kind.name} strikes as the board starts; leave it out")
        if self.fault.phase and not kind.takes_phase:
            takers = ", ".join(other.name for other in KINDS if other.takes_phase)
            yield self._mistake("phase", f"{kind.name} begins with a cycle; kinds that strike within a tick: {takers}")
        if self.fault.mailbox is not None and not kind.takes_mailbox:
            takers = ", ".join(other.name for other in KINDS if other.takes_mailbox)
            yield self._mistake("mailbox", f"{kind.name} is of no mailbox; kinds that are: {takers}")
        yield from self._parameters(kind)

    def _parameters(self, kind: Kind) -> Iterator[Mistake]:
        known = {parameter.name: parameter for parameter in kind.parameters}
        for name, value in self.fault.parameters.items():
            if name not in known:
                why = f"{kind.name} has no such parameter; parameters: {', '.join(known) or 'none'}"
                yield Mistake(self._at(name), _plain(value), why)
            elif why := _range(known[name], value, self._joints()):
                yield Mistake(self._at(name), _plain(value), why)
        for parameter in kind.parameters:
            if parameter.default is None and parameter.name not in self.fault.parameters:
                yield Mistake(self._at(parameter.name), None, f"missing; {parameter.meaning}, {parameter.unit}")

    def _fit(self, kind: Kind, tasks: Mapping[str, Role]) -> Iterator[Mistake]:
        """Whether the task can have such a fault."""
        board = self.fault.board
        if board == CLOCK:
            if kind.name not in FOR_THE_CLOCK:
                yield self._mistake("board", f"the clock has no {kind.name}; its kinds: {', '.join(FOR_THE_CLOCK)}")
        elif kind.where == "clock":
            yield self._mistake("board", f'{kind.name} is of the clock; permitted: "{CLOCK}"')
        elif tasks[board] != ROLES.get(kind.name, tasks[board]):
            role = ROLES[kind.name]
            fitting = ", ".join(name for name, other in tasks.items() if other == role) or "none"
            yield self._mistake("board", f"{kind.name} is of {role}s; {role}s: {fitting}")
        elif kind.where == "arm" and board not in (driving := self._driving(kind)):
            yield self._mistake("board", f"drives nothing that can have {kind.name}; boards: {_listed(driving)}")
        elif kind.where in WRITERS and self.layout is not None:
            yield from self._mailbox(kind, self.layout)

    def _mailbox(self, kind: Kind, layout: Layout) -> Iterator[Mistake]:
        written = {m.name: m for m in layout.mailboxes if m.writer == self.fault.board}
        wanted = self.fault.mailbox
        if wanted is not None and wanted not in written:
            yield self._mistake("mailbox", f"'{self.fault.board}' does not write it; it writes: {_listed(written)}")
        elif kind.where == "bus" and wanted is None and not any(m.readers for m in written.values()):
            yield self._mistake("mailbox", f"missing; nobody reads what '{self.fault.board}' writes")
        elif kind.where == "lock":
            locked = [name for name, mailbox in written.items() if mailbox.protocol == "lock"]
            if wanted not in locked if wanted is not None else not locked:
                why = f"lock-held needs protocol lock; mailboxes of '{self.fault.board}' with it: {_listed(locked)}"
                yield self._mistake("mailbox", why)

    def _tasks(self) -> dict[str, Role]:
        tasks: dict[str, Role] = {}
        for name, board in self.config.board.items():
            tasks[name] = "executor"
            if board.planner is not None:
                tasks[f"{name}.planner"] = "planner"
        return tasks

    def _driving(self, kind: Kind) -> list[str]:
        """Return the boards whose executors drive what can have such a fault."""
        found = []
        for name, board in self.config.board.items():
            try:
                if kind.name in find_class(board.executor, Executor).faults:
                    found.append(name)
            except LookupError:
                # That there is no such class is a mistake of its own, and told.
                found.append(name)
        return found

    def _joints(self) -> int | None:
        return len(self.config.robot.joints) if self.config.robot is not None else None

    def _value(self, key: str) -> object:
        return self.fault.lasts if key == "for" else getattr(self.fault, key)

    def _at(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key

    def _mistake(self, key: str, why: str) -> Mistake:
        return Mistake(self._at(key), self._value(key), why)


def fault_mistakes(
    faults: Iterable[tuple[str, FaultConfig]],
    config: RackConfig,
    layout: Layout | None = None,
    untold: frozenset[str] = frozenset(),
) -> list[Mistake]:
    """Return everything wrong with faults, given with their places."""
    rules = [FaultRules(place, fault, config, layout, untold) for place, fault in faults]
    found = [mistake for rule in rules for mistake in rule.mistakes()]
    if len(rules) > FAULT_ENTRIES:
        found.append(Mistake("fault", len(rules), f"more than one run can have; permitted: {FAULT_ENTRIES}"))
    return found


def places(config: RackConfig) -> list[tuple[str, FaultConfig]]:
    """Return the faults of a config with their places in it."""
    return [(f"fault[{at}]", fault) for at, fault in enumerate(config.fault)]


def _range(parameter: Parameter, value: float, joints: int | None) -> str:
    """Return why a value is none that the parameter can have; empty when it is one."""
    most = joints - 1 if parameter.name == "joint" and joints is not None else parameter.most
    if not parameter.least <= value <= most or (parameter.is_whole and value != int(value)):
        whole = "whole numbers " if parameter.is_whole else ""
        return f"out of range; permitted: {whole}{parameter.least:g} to {most:g}; {parameter.meaning}, {parameter.unit}"
    return ""


def _plain(value: float) -> float:
    return int(value) if value.is_integer() else value


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
