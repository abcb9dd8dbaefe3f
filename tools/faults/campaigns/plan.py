"""Plan of a trial, and the possible targets of its faults in a rack."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.queue import is_position_mailbox
from rack.boards.config.connections import find_executors
from rack.boards.config.schema import RackConfig
from rack.boards.config.toml import to_toml
from rack.boards.faults.bounds import compute_read_interval, cycle_ticks
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS, Kind
from rack.tools.console.answer import Failure
from rack.tools.faults.ending import EXTERNAL, find_record

Purpose = Literal["faults", "kills", "sizes", "nominal", "faultless"]


@dataclass(frozen=True)
class Kill:
    """One external SIGKILL, which a campaign sends without the fault table.

    Attributes:
        board: Board whose process is killed.
        tick: Tick of the kill.
        phase: Fraction of the tick that passes before the kill.
    """

    board: str
    tick: int
    phase: float


@dataclass(frozen=True)
class Plan:
    """Faults and mode of one trial.

    The command `rack run CONFIG --faults FILE` repeats a plan that was written to a file.

    Attributes:
        number: Number of the trial. 0 for a run without faults.
        purpose: Purpose of the run.
        lockstep: Whether it runs in lockstep.
        faults: Tables of faults as in a config.
        kills: External kills.
    """

    number: int
    purpose: Purpose
    lockstep: bool
    faults: tuple[Mapping[str, Any], ...] = ()
    kills: tuple[Kill, ...] = ()

    @property
    def name(self) -> str:
        """Name of the run, built from its number, or from its purpose if the number is 0."""
        return f"trial {self.number}" if self.number else f"{self.purpose} run"

    @property
    def first_tick(self) -> int:
        """Tick at which the first fault begins. 0 for a fault that prevents the launch."""
        ticks = [table.get("tick", 0) for table in self.faults] + [kill.tick for kill in self.kills]
        return min(ticks, default=0)

    def to_config(self, config: RackConfig, rack: str) -> RackConfig:
        """Return a copy of a config with this plan's clock mode and faults and a new rack name."""
        clock: dict[str, Any] = {"mode": "realtime"}
        if self.lockstep:
            # A speed is meaningless in lockstep.
            clock = {"mode": "lockstep", "speed": 1.0}
        faults = tuple(FaultConfig.model_validate(table) for table in self.faults)
        return config.model_copy(
            update={
                "name": rack,
                "clock": config.clock.model_copy(update=clock),
                "fault": config.fault + faults,
            }
        )

    def move_faults(self, ticks: Sequence[int]) -> Plan:
        """Return a copy of the plan whose faults begin at the given ticks."""
        moved = ({**table, "tick": tick} for table, tick in zip(self.faults, ticks, strict=True))
        return replace(self, faults=tuple(moved))

    def format_faults(self, config: str) -> str:
        """Return the content of a file for `--faults` that repeats this plan.

        External kills cannot be expressed in such a file, so they are written as comments.
        """
        mode = " --lockstep" if self.lockstep else ""
        faults = to_toml({"fault": [dict(table) for table in self.faults]})
        kills = [
            f"# {EXTERNAL}: {kill.board} at tick {kill.tick} + {kill.phase:g}"
            for kill in self.kills
        ]
        head = f"# Trial {self.number}: rack run {config}{mode} --faults THIS_FILE"
        return "\n".join([head, *kills, "", faults])


NOMINAL = Plan(0, "nominal", lockstep=True)


def strike_active_copies(plans: Iterable[Plan], layout: Layout, board: str) -> list[Plan]:
    """Return plans whose faults strike the copies of a board in turn, as they become active."""
    names = [copy.name for copy in layout.list_copies(board)][:2]
    return [
        replace(
            plan,
            faults=tuple(
                {**fault, "board": names[number % len(names)]}
                for number, fault in enumerate(plan.faults)
            ),
        )
        for plan in plans
    ]


def needs_real_time(kind: str) -> bool:
    """Return True if faults of a kind are not useful in lockstep.

    Either the kind is impossible in lockstep, or its delay is meaningless because no simulated
    time passes while a process dies.
    """
    return kind == EXTERNAL or KINDS[kind].realtime


@dataclass(frozen=True)
class Target:
    """A task or mailbox that a fault of a kind may affect.

    Attributes:
        kind: Name of the kind.
        board: Affected task.
        cycle: Period in ticks of the task or of the mailbox's messages.
        mailbox: Affected mailbox. None for a fault of the whole task.
        reader: Period in ticks of the mailbox's fastest reader.
    """

    kind: str
    board: str
    cycle: int
    mailbox: str | None = None
    reader: int = 0

    @property
    def record(self) -> Kind:
        """Record that describes the kind."""
        return find_record(self.kind)


class Targets:
    """The tasks and mailboxes of a rack in which faults of each kind can act and be detected.

    Attributes:
        layout: Layout of the rack.
        joints: Number of joints of the arm.
        by_kind: Dictionary from the name of each kind to its targets.
    """

    def __init__(self, config: RackConfig, layout: Layout, board: str = "") -> None:
        """Find the targets.

        Args:
            config: Config of the rack.
            layout: Its layout.
            board: The only board that may be affected. Empty for all.
        """
        self.layout = layout
        self.joints = len(config.robot.joints) if config.robot is not None else 0
        # Only boards whose copies are compared can find a wrong output.
        self._compared = {name for name, b in config.board.items() if b.compare or b.vote}
        self._roles = {task.name: task.role for task in layout.tasks}
        self._driving = {name: kind.faults for name, kind in find_executors(config).items()}
        self.by_kind = {kind.name: self._find_targets(kind) for kind in KINDS}
        # An external kill may also hit the clock's process.
        self.by_kind[EXTERNAL] = self._build_targets(EXTERNAL, [*self._roles, CLOCK])
        if board:
            self.by_kind = {
                kind: [target for target in targets if target.board == board]
                for kind, targets in self.by_kind.items()
            }

    def _find_targets(self, kind: Kind) -> list[Target]:
        """Return the tasks or mailboxes in which a fault of a kind can be detected."""
        if not kind.takes_mailbox:
            return self._build_targets(kind.name, self._list_tasks(kind))
        targets = []
        for box in filter(partial(self._is_detectable, kind), self.layout.mailboxes):
            # The servo level writes a scene only in every n-th cycle.
            cycle = max(cycle_ticks(self.layout, box.writer), box.every)
            reader = min(compute_read_interval(self.layout, box, reader) for reader in box.readers)
            targets.append(Target(kind.name, box.writer, cycle, box.name, reader))
        return targets

    def _build_targets(self, kind: str, tasks: Iterable[str]) -> list[Target]:
        """Return a target for each of these tasks."""
        return [Target(kind, task, cycle_ticks(self.layout, task)) for task in tasks]

    def _list_tasks(self, kind: Kind) -> list[str]:
        """Return the names of the tasks that a kind without a mailbox may affect."""
        if kind.where == "clock":
            return [CLOCK]
        if kind.where == "arm":
            return [task for task, steps in self._driving.items() if isinstance(kind.step, steps)]
        return [task for task, role in self._roles.items() if role in kind.tasks]

    def _is_detectable(self, kind: Kind, box: MailboxSpec) -> bool:
        """Return True if a fault of this kind in a mailbox can be detected.

        The mailbox must have readers. A fault of its writer is detected by missing messages, so it
        also needs messages at regular intervals, which only executors write.
        """
        # Exclude writers without a role: the clock writes only for operators, and a host board at
        # any time.
        role = self._roles.get(box.writer)
        if role is None or not box.readers:
            return False
        if kind.where == "lock" and box.protocol != "lock":
            return False
        if kind.where == "copy" and box.writer not in self._compared:
            return False
        # A queue is written on demand. The position of its reader is not written through a port.
        if kind.where == "writer" and (box.protocol == "queue" or is_position_mailbox(box)):
            return False
        return role in kind.tasks and (kind.where != "writer" or role == "executor")


def select_kinds(wanted: str | None, targets: Targets, realtime: bool) -> list[str]:
    """Return the names of the kinds of a campaign.

    Args:
        wanted: Names of kinds, separated by commas. None for all that are possible in the rack.
        targets: Targets in the rack.
        realtime: Whether the campaign includes real time.

    Raises:
        Failure: A kind is unknown, or the rack cannot have it.
    """
    needs_real_time_by_kind = {kind.name: kind.realtime for kind in KINDS} | {EXTERNAL: False}
    possible = [
        name
        for name, needs in needs_real_time_by_kind.items()
        if (realtime or not needs) and targets.by_kind[name]
    ]
    if wanted is None:
        return possible
    named = dict.fromkeys(name.strip() for name in wanted.split(",") if name.strip())
    valid_text = f"valid kinds: {', '.join(possible)}"
    for name in named:
        if name not in needs_real_time_by_kind:
            raise Failure(f"--kinds {name}: there is no such kind; {valid_text}", 2)
        if needs_real_time_by_kind[name] and not realtime:
            why = f"{name} needs real time, and the campaign is in lockstep"
            raise Failure(f"--kinds {name}: {why}; {valid_text}", 2)
        if name not in possible:
            raise Failure(f"--kinds {name}: nothing in this rack can have it; {valid_text}", 2)
    if not named:
        raise Failure(f"--kinds names no kind; {valid_text}", 2)
    return list(named)
