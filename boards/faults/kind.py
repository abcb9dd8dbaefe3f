"""A kind of fault is one record, `Kind`. Help, check, injection, judgement and campaigns all read this record alone.

The project's own kinds are in `rack.boards.faults.kinds`. A level's author adds one next to the level:

    KINDS.add(Kind(name="gauge-stuck", where="writer", ...))

Every process of a rack imports the levels' modules, so all of them know the kind.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import Literal
from zlib import crc32

from rack.backplane.address_map import CLOCK
from rack.backplane.fault_table import PARAMETERS, FaultEntry, Injection
from rack.backplane.layout import Layout
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults.bounds import NOT_ARMED, Bound, BoundCase, cycle_ticks
from rack.boards.faults.drawing import Draw, DrawTicks

Where = Literal["process", "load", "core", "writer", "bus", "lock", "clock", "arm", "start"]
"""The place at which a step acts. `process`, `clock`, `bus`: the clock's board, at the beginning of a tick. `load`,
`writer`, `lock`: the task itself. `core`: another process on the task's core. `arm`: the level that drives the arm.
`start`: the board, as it starts."""
Struck = Literal["executor", "planner", "clock"]
Died = Literal["died"]
DIED: Died = "died"
"""As a detection: the Rack has seen the process die."""
RECOVERY_S = 0.25
"""Simulated time after a fault within which reactions are undone, where a kind does not say otherwise."""


@dataclass(frozen=True)
class Parameter:
    """A number that a kind takes: unit, range and meaning. `default` None: it must be given.

    Its name must not be a key of every fault: see `rack.boards.faults.config.FaultConfig`. `drawn` draws it for a
    campaign; None: a campaign leaves it at its default.
    """

    name: str
    unit: str
    meaning: str
    default: float | None
    least: float
    most: float
    is_whole: bool = False
    drawn: Draw | None = None


@dataclass(frozen=True)
class Consequence:
    """The effects of a kind besides its detection. An alarm that no fault explains in this way is a false one.

    `own`: further alarms about the fault's task, mailboxes or joint. `arm`: alarms about any joint. `reactions`: codes
    of events, all of which must follow. `recovery_s`: simulated time from the end of the fault, or its detection,
    within which every reaction is undone. `ends_process`: its task's process ends, which allows for a restart as well.
    `latches`: it may end the task with an error instead of being undone.
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

    `step` is what acts, of the class that `where` asks for: a `ClockStep`, a class of `MessageStep`s, a `LoadStep`, a
    function that a process of its own runs (`core`), a step of `rack.levels.faults` (`arm`); none for `start`.
    `tasks` can be struck. `detected_as`: alarms, or "died", that count as its detection, within `bound`. `lasts` draws
    how long it lasts in a campaign, in ticks.

    `realtime`: it does not exist in lockstep, where time waits for every task. `once`: it strikes and is over; others
    last for a time, or until the end of the run. `within_tick`: it can strike within a tick; others begin with a cycle.
    `visible_from`: the value of its parameter `size` from which it must be found.
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

    @property
    def number(self) -> int:
        """The kind in the fault table: from its name alone, so that all processes agree."""
        return crc32(self.name.encode())

    @property
    def takes_mailbox(self) -> bool:
        """Whether it is about messages: of one mailbox, or of all that the task writes."""
        return self.where in ("writer", "bus", "lock")

    @property
    def is_of_task(self) -> bool:
        """Whether the task's own process acts it, in its cycles."""
        return self.where in ("load", "writer", "lock", "arm")

    @property
    def is_over_when_found(self) -> bool:
        """Whether a fault that lasts is over when it is found, because the Rack then ends its process."""
        return self.consequence.ends_process and not self.once

    @property
    def recoverable(self) -> bool:
        """Whether the task continues after it."""
        return self.where != "start"

    @cached_property
    def codes(self) -> tuple[str, ...]:
        """The codes of events that count as its detection."""
        return tuple(found if isinstance(found, str) else found.name.lower() for found in self.detected_as)

    @property
    def size(self) -> Parameter | None:
        """The parameter that decides whether the fault can be seen; None when it always can."""
        return None if self.visible_from is None else next(p for p in self.parameters if p.name == "size")

    def values(self, entry: FaultEntry) -> dict[str, float]:
        """Return the parameters that an entry of the fault table holds, by name."""
        return {p.name: value for p, value in zip(self.parameters, entry.parameters, strict=False)}

    def bound_ticks(self, injection: Injection, layout: Layout, reader: str | None = None) -> int | None:
        """Return the ticks from the tick at which a fault first acted to its detection; None: there is no bound.

        `reader` is the task that finds it; None: whichever finds it first, for a death the Rack. A mailbox without
        readers has no bound.
        """
        given = {p.name: value for p, value in zip(self.parameters, injection.parameters, strict=False)}
        case = BoundCase(layout, injection, given, reader)
        needs_reader = self.takes_mailbox or (self.detected_as == (DIED,) and reader is not None)
        return None if needs_reader and not case.mailboxes else self.bound.ticks(case)

    def recovery_ticks(self, board: str, layout: Layout, restart_s: float) -> int:
        """Return the ticks from the end of a fault, or its detection, within which all reactions must be undone.

        `restart_s`: simulated time that a restart may take. A restarted board is back at its next release; a planner's
        executor continues when its first plan is there.
        """
        ends = self.consequence.ends_process
        cycle = cycle_ticks(layout, board) if ends and board != CLOCK else 0
        return cycle + ceil((self.consequence.recovery_s + ends * restart_s) * 1e9 / layout.clock_ns)


UNKNOWN = Kind("unknown fault", "process", "added by a module that is not imported here", (), NOT_ARMED)


class Kinds:
    """The kinds that this process knows, in the order in which they were added."""

    def __init__(self) -> None:
        self._by_name: dict[str, Kind] = {}
        self._by_number: dict[int, Kind] = {}

    def add(self, *kinds: Kind) -> None:
        """Add kinds. Raises `ValueError` for a name or number in use, or more parameters than an entry holds."""
        for kind in kinds:
            if kind.number in self._by_number:
                raise ValueError(f"kind '{kind.name}': there is one already: '{self._by_number[kind.number].name}'")
            if len(kind.parameters) > PARAMETERS:
                raise ValueError(f"kind '{kind.name}': {len(kind.parameters)} parameters; at most {PARAMETERS}")
            self._by_name[kind.name] = self._by_number[kind.number] = kind

    def __iter__(self) -> Iterator[Kind]:
        return iter(self._by_name.values())

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __getitem__(self, key: str | int) -> Kind:
        """Return the kind of a name, or of a number in the fault table. Raises `KeyError` for an unknown name."""
        return self._by_name[key] if isinstance(key, str) else self._by_number.get(key, UNKNOWN)

    @property
    def names(self) -> Mapping[str, Kind]:
        """The kinds by name."""
        return self._by_name


KINDS = Kinds()
