"""A kind of fault is one record, `Kind`: help, checks, injection, judgement and campaigns use
nothing else.

The project's own kinds are in `rack.boards.faults.kinds`. A level's author adds one next to the
level:

    KINDS.add(Kind(name="gauge-stuck", where="writer", ...))

Every process of a rack imports the modules of its levels, so all of them know the kind. Programs
that look at the rack know it as the rack publishes it: see `rack.boards.config.published`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import Literal
from zlib import crc32

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import PARAMETERS, FaultEntry, Injection
from rack.backplane.layout import Layout
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults.bounds import NOT_ARMED, Bound, BoundCase, cycle_ticks, struck_mailboxes
from rack.boards.faults.drawing import Draw, DrawTicks

Where = Literal["process", "load", "core", "writer", "bus", "lock", "clock", "arm", "start"]
"""The place where a step acts. `process`, `clock`, `bus`: the clock's board, at the start of a
tick. `load`, `writer`, `lock`: the task itself. `core`: another process on the task's core. `arm`:
the level that drives the arm. `start`: the board, as it starts."""
Struck = Literal["executor", "planner", "clock", "host"]
Died = Literal["died"]
DIED: Died = "died"
"""Detection by the Rack: the process died."""
RECOVERY_S = 0.25
"""Default time after a fault within which reactions are undone, s of simulated time."""


@dataclass(frozen=True)
class Parameter:
    """A numeric parameter of a kind: unit, range and meaning. `default` None: it must be given.

    Its name must not be a key of every fault: see `rack.boards.faults.config.FaultConfig`. A
    campaign draws its value with `drawn`; None: it keeps the default.
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
        """Return its meaning, with its unit."""
        return self.meaning if self.unit == "1" else f"{self.meaning}, {self.unit}"


@dataclass(frozen=True)
class Consequence:
    """The effects of a kind besides its detection. Any alarm that these do not explain is a false
    alarm.

    `own`: further alarms about the fault's task, mailboxes or joint. `arm`: alarms about any joint.
    `reactions`: codes of events that must all follow. `recovery_s`: simulated time from the end of
    the fault, or its detection, within which every reaction is undone. `ends_process`: the task's
    process ends; recovery includes its restart. `latches`: the task may end with an error instead
    of recovering.
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

    `step` does the damage. Its type depends on `where`: a `ClockStep`, a subclass of `MessageStep`,
    a `LoadStep`, a function run by a separate process (`core`), a step of `rack.levels.fault_steps`
    (`arm`); `start` needs none. `tasks` lists the roles that can be struck. `detected_as`: alarms,
    or "died", that count as its detection, within `bound`. `lasts` draws its duration in a
    campaign, ticks.

    `realtime`: impossible in lockstep, where time waits for every task. `once`: it strikes once;
    other kinds last for a time or until the run ends. `within_tick`: it can strike within a tick;
    other kinds begin with a cycle. `visible_from`: the smallest value of its parameter `size` that
    must be detected. `not_queued`: why it does not strike queues; empty if it does.
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
        """Number of the kind in the fault table, derived from its name so that all processes
        agree.
        """
        return crc32(self.name.encode())

    @property
    def takes_mailbox(self) -> bool:
        """Whether it affects messages: of one mailbox, or of all that the task writes."""
        return self.where in ("writer", "bus", "lock")

    @property
    def is_of_task(self) -> bool:
        """Whether it acts in the task's own process, during its cycles."""
        return self.where in ("load", "writer", "lock", "arm")

    @property
    def is_over_when_found(self) -> bool:
        """Whether detection ends a lasting fault, because the Rack then kills the process."""
        return self.consequence.ends_process and not self.once

    @property
    def recoverable(self) -> bool:
        """Whether the task continues after it."""
        return self.where != "start"

    @cached_property
    def codes(self) -> tuple[str, ...]:
        """The codes of events that count as its detection."""
        return tuple(
            found if isinstance(found, str) else found.name.lower() for found in self.detected_as
        )

    @property
    def size(self) -> Parameter | None:
        """The parameter that decides whether the fault is detectable; None if it always is."""
        if self.visible_from is None:
            return None
        return next(p for p in self.parameters if p.name == "size")

    def values(self, fault: FaultEntry | Injection) -> dict[str, float]:
        """Return the parameters that a fault of this kind holds, by name."""
        return {p.name: value for p, value in zip(self.parameters, fault.parameters, strict=False)}

    def bound_ticks(
        self, injection: Injection, layout: Layout, reader: str | None = None
    ) -> int | None:
        """Return the bound from the tick at which a fault first shows to its detection, ticks;
        None: no bound.

        `reader` is the task that detects it; None: the first to do so, for a death the Rack. A
        mailbox without readers has no bound.
        """
        case = BoundCase(layout, injection, self.values(injection), reader)
        needs_reader = self.takes_mailbox or (self.detected_as == (DIED,) and reader is not None)
        return None if needs_reader and not case.mailboxes else self.bound.ticks(case)

    def recovery_ticks(self, board: str, layout: Layout, restart_s: float) -> int:
        """Return the time from the end of a fault, or its detection, within which all is well
        again, ticks.

        `restart_s`: simulated time that a restart may take. A restarted board rejoins at its next
        release; the executor of a restarted planner continues with its first plan. Messages flow
        again with the next one of each mailbox.
        """
        ends = self.consequence.ends_process
        cycle = cycle_ticks(layout, board) if ends and board != CLOCK else 0
        if self.takes_mailbox:
            cycle += max(
                (box.every + box.delay for box in struck_mailboxes(layout, -1, board)), default=0
            )
        return cycle + ceil(
            (self.consequence.recovery_s + ends * restart_s) * 1e9 / layout.clock_ns
        )


UNKNOWN = Kind(
    "unknown fault", "process", "added by a module that is not imported here", (), NOT_ARMED
)


class Kinds:
    """The kinds known to this process, in the order of their addition."""

    def __init__(self) -> None:
        self._by_name: dict[str, Kind] = {}
        self._by_number: dict[int, Kind] = {}

    def add(self, *kinds: Kind) -> None:
        """Add kinds. Raises `ValueError` for a name or number in use, or for too many
        parameters.
        """
        for kind in kinds:
            if kind.number in self._by_number:
                raise ValueError(
                    f"kind '{kind.name}': already taken by '{self._by_number[kind.number].name}'"
                )
            if len(kind.parameters) > PARAMETERS:
                raise ValueError(
                    f"kind '{kind.name}': {len(kind.parameters)} parameters; permitted:"
                    f" {PARAMETERS}"
                )
            self._by_name[kind.name] = self._by_number[kind.number] = kind

    def adopt(self, kinds: Iterable[Kind]) -> None:
        """Add the kinds that a rack has published and this process does not know."""
        self.add(*(kind for kind in kinds if kind.number not in self._by_number))

    def __iter__(self) -> Iterator[Kind]:
        return iter(self._by_name.values())

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __getitem__(self, key: str | int) -> Kind:
        """Return the kind of a name, or of a number in the fault table. Raises `KeyError` for an
        unknown name.
        """
        return self._by_name[key] if isinstance(key, str) else self._by_number.get(key, UNKNOWN)

    @property
    def names(self) -> Mapping[str, Kind]:
        """The kinds by name."""
        return self._by_name


KINDS = Kinds()


def kind_of(entry: FaultEntry) -> Kind:
    """Return the kind of a fault in the fault table."""
    return KINDS[entry.kind]
