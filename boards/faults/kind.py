"""The record that describes a fault kind.

Help, checks, injection, reports and campaigns use only this record. The project's own kinds are
in `rack.boards.faults.kinds`. The author of a level adds a kind next to the level:

    KINDS.add(Kind(name="gauge-stuck", where="writer", ...))

Every process of a rack imports the modules of its levels, so all of them know the kind. Programs
that observe the rack read the kinds that it publishes: see `rack.boards.config.published`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import Literal
from zlib import crc32

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import PARAMETERS, FaultEntry, Injection
from rack.backplane.layout import Layout
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults.bounds import (
    NOT_ARMED,
    Bound,
    BoundCase,
    cycle_ticks,
    list_affected_mailboxes,
)
from rack.boards.faults.drawing import Draw, DrawTicks

Where = Literal["process", "load", "core", "writer", "copy", "bus", "lock", "clock", "arm", "start"]
"""Process in which a step acts, and when.

- `process`, `clock`, `bus`: in the clock's board, at the start of a tick.
- `load`, `writer`, `lock`: in the task itself.
- `copy`: in the task itself, also while it is a standby that holds its messages back.
- `core`: in a separate process on the task's core. In lockstep, in each task of that core.
- `arm`: in the level that drives the arm.
- `start`: in the board as it starts.
"""
Struck = Literal["executor", "planner", "clock", "host"]
Died = Literal["died"]
DIED: Died = "died"
"""Detection of a process's death by the Rack."""
RECOVERY_S = 0.25
"""Default simulated time in s after a fault within which reactions must be undone."""


@dataclass(frozen=True)
class Parameter:
    """A numeric parameter of a kind.

    Attributes:
        name: Name. It must differ from the keys of `rack.boards.faults.config.FaultConfig`.
        unit: Unit, or "1".
        meaning: What the value means, for help texts.
        default: Default value. None if the parameter is required.
        least: Smallest valid value.
        most: Largest valid value.
        is_whole: Whether the value must be an integer.
        drawn: Draws the value in a campaign. None keeps the default.
    """

    name: str
    unit: str
    meaning: str
    default: float | None
    least: float
    most: float
    is_whole: bool = False
    drawn: Draw | None = None

    def __str__(self) -> str:
        """Return the meaning with the unit."""
        return self.meaning if self.unit == "1" else f"{self.meaning}, {self.unit}"


@dataclass(frozen=True)
class Consequence:
    """Effects of a kind besides its detection. Any alarm that they do not explain is a false alarm.

    Attributes:
        own: Further alarms about the fault's task, mailboxes or joint.
        arm: Alarms about any joint.
        reactions: Codes of events that must all follow.
        recovery_s: Simulated time, in s, within which every reaction is undone. It is counted from
            the end of the fault or from its detection.
        ends_process: Whether the task's process ends, so that recovery includes its restart.
        latches: Whether the task may end with an error instead of recovering.
    """

    own: tuple[Alarm, ...] = ()
    arm: tuple[Alarm, ...] = ()
    reactions: tuple[str, ...] = ()
    recovery_s: float = RECOVERY_S
    ends_process: bool = False
    latches: bool = False


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        name: Name of the kind.
        where: Where the step acts.
        means: What happens, for help texts.
        detected_as: Alarms, or "died", that count as detection.
        bound: Time within which the fault must be detected.
        step: Carries out the fault. Its type depends on `where`: a `ClockStep`, a subclass of
            `MessageStep`, a `LoadStep`, a function that a separate process runs (`core`), or a step
            of `rack.levels.fault_steps` (`arm`). None for `start`.
        parameters: Parameters of the kind.
        tasks: Roles that can be affected.
        consequence: Effects besides detection.
        lasts: Draws the duration in ticks for a campaign.
        realtime: Whether the fault is only possible in real time. In lockstep, time waits for every
            task.
        once: Whether it acts only once. Other faults last for a time or until the run ends.
        within_tick: Whether it can act within a tick. Other faults begin with a cycle.
        visible_from: Smallest value of the parameter `size` that must be detected.
        not_queued: Why the kind does not affect queues. Empty if it does.
    """

    name: str
    where: Where
    means: str
    detected_as: tuple[Alarm | Died, ...]
    bound: Bound
    step: object = None
    parameters: tuple[Parameter, ...] = ()
    tasks: tuple[Struck, ...] = ("executor", "planner")
    consequence: Consequence = Consequence()
    lasts: DrawTicks | None = None
    realtime: bool = False
    once: bool = False
    within_tick: bool = False
    visible_from: float | None = None
    not_queued: str = ""

    @property
    def number(self) -> int:
        """Number of the kind in the fault table: a checksum of its name, equal in every process."""
        return crc32(self.name.encode())

    @property
    def takes_mailbox(self) -> bool:
        """Whether the fault affects messages, in one mailbox or in all that the task writes."""
        return self.where in ("writer", "copy", "bus", "lock")

    @property
    def takes_one_mailbox(self) -> bool:
        """Whether it affects a single mailbox, by default the first of its task with a reader."""
        return self.where in ("copy", "bus")

    @property
    def acts_in_task(self) -> bool:
        """Whether the fault acts in the task's own process, during its cycles."""
        return self.where in ("load", "writer", "copy", "lock", "arm")

    @property
    def recoverable(self) -> bool:
        """Whether the task can continue after the fault."""
        return self.where != "start"

    @cached_property
    def codes(self) -> tuple[str, ...]:
        """Codes of the events that count as detection."""
        return tuple(
            cause if isinstance(cause, str) else cause.name.lower() for cause in self.detected_as
        )

    @property
    def size(self) -> Parameter | None:
        """The parameter `size`, if faults below a certain size need not be detected, else None."""
        if self.visible_from is None:
            return None
        return next(p for p in self.parameters if p.name == "size")

    def read_parameters(self, fault: FaultEntry | Injection) -> dict[str, float]:
        """Return a dictionary from parameter names to the values of a fault of this kind."""
        return {p.name: value for p, value in zip(self.parameters, fault.parameters, strict=False)}

    def compute_bound_ticks(
        self, injection: Injection, layout: Layout, reader: str | None = None
    ) -> int | None:
        """Compute the detection bound of a fault.

        Args:
            injection: The fault.
            layout: Layout of the rack.
            reader: Task that detects the fault. None for the bound of whichever task detects it
                first or, for a death, of the Rack.

        Returns:
            Ticks from the fault's first effect to its detection. None if there is no bound, as for
            a mailbox that nobody reads.
        """
        case = BoundCase(layout, injection, self.read_parameters(injection), reader)
        needs_reader = self.takes_mailbox or (self.detected_as == (DIED,) and reader is not None)
        return None if needs_reader and not case.mailboxes else self.bound.ticks(case)

    def compute_tail_ticks(self, fault: FaultEntry | Injection, layout: Layout) -> int:
        """Compute the time for which the last cycle that a fault makes longer outlasts the fault.

        Returns:
            The time in ticks. 0 for faults that make no cycle longer.
        """
        if self.where != "load":
            return 0
        task = layout.processes[fault.task]
        return task.slice + ceil(self.read_parameters(fault).get("by", 0.0) * task.every)

    def compute_recovery_ticks(self, board: str, layout: Layout, restart_s: float) -> int:
        """Compute the time within which the rack must have recovered.

        It is the sum of the kind's recovery time, a restart and one cycle of the task if the fault
        ends its process, and the time for a new message in every mailbox if it affects messages.

        Args:
            board: Name of the affected task.
            layout: Layout of the rack.
            restart_s: Simulated time in s that a restart may take.

        Returns:
            Ticks from the end of the fault, or from its detection.
        """
        ends = self.consequence.ends_process
        cycle = cycle_ticks(layout, board) if ends and board != CLOCK else 0
        if self.takes_mailbox:
            cycle += max(
                (box.every + box.delay for box in list_affected_mailboxes(layout, -1, board)),
                default=0,
            )
        return cycle + ceil(
            (self.consequence.recovery_s + ends * restart_s) * 1e9 / layout.clock_ns
        )


UNKNOWN = Kind(
    "unknown fault", "process", "added by a module that is not imported here", (), NOT_ARMED
)


class Kinds:
    """The kinds that this process knows, in the order in which they were added."""

    def __init__(self) -> None:
        self.names: dict[str, Kind] = {}
        """Kinds by name."""
        self._by_number: dict[int, Kind] = {}

    def add(self, *kinds: Kind) -> None:
        """Add kinds.

        Raises:
            ValueError: A name or number is in use, or a kind has too many parameters.
        """
        for kind in kinds:
            if kind.number in self._by_number:
                raise ValueError(
                    f"kind '{kind.name}' has the number of '{self._by_number[kind.number].name}';"
                    " rename it"
                )
            if len(kind.parameters) > PARAMETERS:
                raise ValueError(
                    f"kind '{kind.name}' has {len(kind.parameters)} parameters;"
                    f" at most {PARAMETERS} are allowed"
                )
            self.names[kind.name] = self._by_number[kind.number] = kind

    def add_missing(self, kinds: Iterable[Kind]) -> None:
        """Add the kinds that a rack has published and that this process does not know."""
        self.add(*(kind for kind in kinds if kind.number not in self._by_number))

    def __iter__(self) -> Iterator[Kind]:
        return iter(self.names.values())

    def __getitem__(self, key: str | int) -> Kind:
        """Return the kind with a name, or with a number in the fault table.

        An unknown number gives `UNKNOWN`, because a rack may have kinds that this process cannot
        import.

        Raises:
            KeyError: The name is unknown.
        """
        return self.names[key] if isinstance(key, str) else self._by_number.get(key, UNKNOWN)


KINDS = Kinds()


def find_kind(entry: FaultEntry) -> Kind:
    """Return the kind of an entry of the fault table. `UNKNOWN` if this process lacks it."""
    return KINDS[entry.kind]
