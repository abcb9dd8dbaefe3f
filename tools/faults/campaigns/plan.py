"""The plan of a trial, and the targets in a rack that a plan can choose from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.queue import is_position
from rack.boards.config.connections import executors
from rack.boards.config.schema import RackConfig
from rack.boards.config.toml import to_toml
from rack.boards.faults.bounds import between_reads, cycle_ticks
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS, Kind
from rack.tools.console.answer import Failure
from rack.tools.faults.ending import EXTERNAL, record_of

Purpose = Literal["faults", "kills", "sizes", "nominal", "faultless"]


@dataclass(frozen=True)
class Kill:
    """One SIGKILL from outside, of the process of `board`. `phase` is the part of the tick that has
    passed.
    """

    board: str
    tick: int
    phase: float


@dataclass(frozen=True)
class Plan:
    """One trial. `faults` are tables as in a config; `rack run CONFIG --faults FILE` repeats a
    plan.
    """

    number: int
    purpose: Purpose
    lockstep: bool
    faults: tuple[Mapping[str, Any], ...] = ()
    kills: tuple[Kill, ...] = ()

    @property
    def name(self) -> str:
        """The trial by its number; a run without one by its purpose."""
        return f"trial {self.number}" if self.number else f"{self.purpose} run"

    @property
    def first(self) -> int:
        """The tick at which the first fault begins; 0 for one that prevents the launch."""
        ticks = [table.get("tick", 0) for table in self.faults] + [kill.tick for kill in self.kills]
        return min(ticks, default=0)

    def config(self, config: RackConfig, rack: str) -> RackConfig:
        """Return the config that runs this plan, as a rack of another name."""
        clock: dict[str, Any] = {"mode": "realtime"}
        if self.lockstep:
            # Only real time has a speed.
            clock = {"mode": "lockstep", "speed": 1.0}
        faults = tuple(FaultConfig.model_validate(table) for table in self.faults)
        return config.model_copy(
            update={
                "name": rack,
                "clock": config.clock.model_copy(update=clock),
                "fault": config.fault + faults,
            }
        )

    def toml(self, config: str) -> str:
        """Return the faults as a file for `--faults`; kills from outside, which no file can hold,
        as comments.
        """
        mode = " --lockstep" if self.lockstep else ""
        faults = to_toml({"fault": [dict(table) for table in self.faults]})
        kills = [
            f"# {EXTERNAL}: {kill.board} at tick {kill.tick} + {kill.phase:g}"
            for kill in self.kills
        ]
        head = f"# Trial {self.number}: rack run {config}{mode} --faults THIS_FILE"
        return "\n".join([head, *kills, "", faults])


def needs_real_time(kind: str) -> bool:
    """Return whether a kind does not exist in lockstep, or means nothing there: no time passes
    while a process dies.
    """
    return kind == EXTERNAL or KINDS[kind].realtime


@dataclass(frozen=True)
class Target:
    """A place for a fault. `cycle`: the period of the task, or of a mailbox's messages, ticks;
    `reader`: that of its fastest reader.
    """

    kind: str
    board: str
    cycle: int
    mailbox: str | None = None
    reader: int = 0

    @property
    def record(self) -> Kind:
        """The kind's record."""
        return record_of(self.kind)


class Targets:
    """The places in one rack where a fault of each kind can strike and be seen. `joints` is the
    number of the arm's.
    """

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self.layout = layout
        self.joints = len(config.robot.joints) if config.robot is not None else 0
        self._roles = {task.name: task.role for task in layout.tasks}
        self._driving = {name: kind.faults for name, kind in executors(config).items()}
        self.by_kind = {kind.name: self._of(kind) for kind in KINDS}
        # The clock's process can be killed like any other.
        self.by_kind[EXTERNAL] = self._at(EXTERNAL, [*self._roles, CLOCK])

    def _of(self, kind: Kind) -> list[Target]:
        if not kind.takes_mailbox:
            return self._at(kind.name, self._tasks(kind))
        targets = []
        for box in filter(partial(self._is_seen, kind), self.layout.mailboxes):
            # The servo level writes a scene in one of its cycles out of many.
            cycle = max(cycle_ticks(self.layout, box.writer), box.every)
            reader = min(between_reads(self.layout, box, reader) for reader in box.readers)
            targets.append(Target(kind.name, box.writer, cycle, box.name, reader))
        return targets

    def _at(self, kind: str, tasks: Iterable[str]) -> list[Target]:
        return [Target(kind, task, cycle_ticks(self.layout, task)) for task in tasks]

    def _tasks(self, kind: Kind) -> list[str]:
        if kind.where == "clock":
            return [CLOCK]
        if kind.where == "arm":
            return [task for task, steps in self._driving.items() if isinstance(kind.step, steps)]
        return [task for task, role in self._roles.items() if role in kind.tasks]

    def _is_seen(self, kind: Kind, box: MailboxSpec) -> bool:
        """Return whether the mailbox has readers, and messages often enough: plans are not
        periodic.
        """
        # The clock writes only for an operator, and a host board when its program says so.
        role = self._roles.get(box.writer)
        if role is None or not box.readers:
            return False
        if kind.where == "lock" and box.protocol != "lock":
            return False
        # A queue is written on demand, and the position of its reader through no port.
        if kind.where == "writer" and (box.protocol == "queue" or is_position(box)):
            return False
        return role in kind.tasks and (kind.where != "writer" or role == "executor")


def kinds_for(wanted: str | None, targets: Targets, realtime: bool) -> list[str]:
    """Return the kinds of a campaign, `wanted` as in "kill,mute"; None: all that the rack can have.

    Raises `Failure` for an unknown kind, or one that the rack cannot have.
    """
    known = {kind.name: kind.realtime for kind in KINDS} | {EXTERNAL: False}
    permitted = [
        name for name, needs in known.items() if (realtime or not needs) and targets.by_kind[name]
    ]
    if wanted is None:
        return permitted
    named = dict.fromkeys(name.strip() for name in wanted.split(",") if name.strip())
    kinds = f"kinds: {', '.join(permitted)}"
    for name in named:
        if name not in known:
            raise Failure(f"--kinds {name}: no such kind; {kinds}", 2)
        if known[name] and not realtime:
            why = f"{name} needs real time, and the campaign is in lockstep"
            raise Failure(f"--kinds {name}: {why}; {kinds}", 2)
        if name not in permitted:
            raise Failure(f"--kinds {name}: nothing in this rack can have it; {kinds}", 2)
    if not named:
        raise Failure(f"--kinds: names no kind; {kinds}", 2)
    return list(named)
