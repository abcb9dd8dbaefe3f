"""Where a fault of each kind can strike in a rack, so that somebody can see it."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, MailboxSpec
from rack.boards.config.ports import all_ports
from rack.boards.config.schema import RackConfig
from rack.boards.faults.kinds import KINDS, Kind
from rack.boards.faults.request import cycle_ticks
from rack.levels.level import Executor
from rack.tools.campaign.plan import EXTERNAL
from rack.tools.console.answer import Failure


@dataclass(frozen=True)
class Target:
    """One place for a fault. `cycle`, `reader`: periods in ticks of the task and of its mailbox's fastest reader."""

    kind: str
    board: str
    cycle: int
    mailbox: str | None = None
    reader: int = 0


class Targets:
    """The places for faults in one rack, by kind."""

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self.layout = layout
        self.joints = len(config.robot.joints) if config.robot is not None else 0
        self._roles = {task.name: task.role for task in layout.tasks}
        self._driving = {
            ports.task: ports.kind.faults for ports in all_ports(config, []) if issubclass(ports.kind, Executor)
        }
        self.by_kind = {kind.name: self._of(kind) for kind in KINDS}
        # The clock's process can be killed like any other.
        self.by_kind[EXTERNAL] = [Target(EXTERNAL, task, self._cycle(task)) for task in [*self._roles, CLOCK]]

    def _of(self, kind: Kind) -> list[Target]:
        if kind.takes_mailbox:
            boxes = [box for box in self.layout.mailboxes if self._is_seen(kind, box)]
            return [self._at(kind, box) for box in boxes]
        return [Target(kind.name, task, self._cycle(task)) for task in self._tasks(kind)]

    def _tasks(self, kind: Kind) -> list[str]:
        if kind.where == "clock":
            return [CLOCK]
        if kind.where == "arm":
            return [task for task, kinds in self._driving.items() if kind.name in kinds]
        if kind.where == "load":
            role = "planner" if kind.name == "planner-slow" else "executor"
            return [task for task, other in self._roles.items() if other == role]
        return list(self._roles)

    def _is_seen(self, kind: Kind, box: MailboxSpec) -> bool:
        """Whether somebody reads the mailbox, and messages come often enough: plans are no periodic messages."""
        # What the clock writes is an operator's.
        if not box.readers or box.writer == CLOCK or (kind.where == "lock" and box.protocol != "lock"):
            return False
        return kind.where != "writer" or self._roles[box.writer] == "executor"

    def _at(self, kind: Kind, box: MailboxSpec) -> Target:
        reader = min(cycle_ticks(self.layout, task) for task in box.readers)
        return Target(kind.name, box.writer, self._cycle(box.writer), box.name, reader)

    def _cycle(self, task: str) -> int:
        return cycle_ticks(self.layout, task)


def kinds_for(wanted: str | None, targets: Targets, lockstep: bool, realtime: bool) -> list[str]:
    """Return the kinds of a campaign, `wanted` as in "kill,mute"; None: all that the rack can have.

    Raises `Failure` for a kind that is none, or that the rack cannot have.
    """
    known = {kind.name: kind.realtime for kind in KINDS} | {EXTERNAL: False}
    permitted = [name for name, needs in known.items() if (realtime or not needs) and targets.by_kind[name]]
    if wanted is None:
        return permitted
    named = [name.strip() for name in wanted.split(",") if name.strip()]
    for name in named:
        if name not in permitted:
            why = "no such kind" if name not in known else _why_not(name, lockstep, realtime, known[name])
            raise Failure(f"--kinds {name}: {why}; kinds: {', '.join(permitted)}", 2)
    if not named:
        raise Failure(f"--kinds: names none; kinds: {', '.join(permitted)}", 2)
    return list(dict.fromkeys(named))


def _why_not(name: str, lockstep: bool, realtime: bool, needs_time: bool) -> str:
    if needs_time and lockstep and not realtime:
        return f"{name} needs real time, and the campaign is in lockstep"
    return "nothing in this rack can have it"
