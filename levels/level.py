"""A level: an executor every cycle and a planner in the background (fig. 1).

The author of a level writes `process` and `plan`; pinning, timing, tracing, mailboxes and faults
stay outside, in the board that runs it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

from rack.backplane.alarms import Alarm
from rack.backplane.mailbox import Reading, Verdict
from rack.backplane.message import Message, MessageType
from rack.backplane.words import Demand
from rack.levels.operator import Commands
from rack.levels.robot import RobotConfig, Table
from rack.levels.scene import SceneConfig

__all__ = [
    "Demand",
    "Executor",
    "Fault",
    "Finding",
    "Input",
    "LevelContext",
    "Pace",
    "Planner",
    "Ports",
    "Reading",
    "Verdict",
]


class Input(NamedTuple):
    """A port that a level reads.

    `source` is a mailbox ("world.model"), or is relative to the level: "above.command",
    "below.status", "own.plan". A config may wire the port elsewhere.
    """

    type: MessageType
    source: str


class Ports(SimpleNamespace):
    """The ports of one cycle by name: `Reading`s for inputs, `Message`s for outputs."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"no port '{name}'; ports: {', '.join(sorted(self.__dict__))}")


class Pace(NamedTuple):
    """How often a level cycles, in ticks, and how many of its cycles one of its plans may take."""

    every: int
    within_cycles: int


class Fault(NamedTuple):
    """A fault that is injected into what a level drives: its kind, as in "sensor-nan", and the kind's parameters.

    `seed` makes everything random in it repeatable; `since` is the tick at which it began. `step` is what acts, of one
    of the classes that the level names in `faults`.
    """

    kind: str
    parameters: Mapping[str, float]
    seed: int
    since: int
    step: object


class Finding(NamedTuple):
    """What a level has found wrong, for its board to ring: see `rack.backplane.alarms.Alarm` for subject and value."""

    alarm: Alarm
    subject: int = -1
    value: float = 0.0


@dataclass(frozen=True)
class LevelContext:
    """What a level knows of its rack, from the config. Times are ticks of the system clock.

    `below` is the pace of the level below; None for a level that has none.
    """

    board: str
    every: int
    within_cycles: int
    clock_ns: int
    seed: int
    robot: RobotConfig
    scene: SceneConfig
    task: Mapping[str, Any]
    sizes: Mapping[str, int]
    below: Pace | None
    params: Mapping[str, Any] = field(default_factory=dict)

    @property
    def period_s(self) -> float:
        """The level's cycle, in s."""
        return self.every * self.clock_ns * 1e-9

    @property
    def tick_s(self) -> float:
        """One tick of the system clock, in s."""
        return self.clock_ns * 1e-9


class Executor(ABC):
    """The foreground of a level: runs every cycle, at high priority, in bounded time.

    Subclasses name their ports and write `process`. Output messages keep their values from cycle to
    cycle; each is written to its mailbox `<board>.<port>` at the end of every cycle.
    """

    inputs: ClassVar[Mapping[str, Input]] = {}
    outputs: ClassVar[Mapping[str, MessageType]] = {}
    faults: ClassVar[tuple[type, ...]] = ()
    """Classes of steps by which faults can strike what the level drives: see `rack.levels.faults`."""
    commands: ClassVar[Commands] = {}
    """What an operator may tell the level, and how goals are given: of one that reads "own.operator"."""
    params: ClassVar[type[Table] | None] = None
    """What `[board.<name>.params]` may hold, checked before the launch; None: whatever the level reads by itself."""

    def __init__(self, context: LevelContext) -> None:
        self.context = context
        self.demand = Demand.NONE  # what the safety of the rack asks of the arm in this cycle; set by the board
        self.findings: list[Finding] = []  # filled in `process`; the board rings and clears them
        self.acted: list[int] = []  # places, in what was injected, of the faults that acted in this cycle; likewise

    def inject(self, faults: Sequence[Fault]) -> None:
        """Take over the faults that are injected from now on, all that are active; empty: none is."""

    def self_test(self) -> None:
        """Raise `LevelError` when the level must not start; the board then holds SYSFAIL."""

    @abstractmethod
    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Compute one cycle, released at `tick`: sample `read`, fill `write`."""

    def close(self) -> None:
        """Release what the level holds; called once, after the last cycle."""


class Planner(ABC):
    """The background of a level: plans ahead, at low priority, within `within_cycles` cycles.

    A planner has one output, `plan`, its mailbox `<board>.plan`.
    """

    inputs: ClassVar[Mapping[str, Input]] = {}
    output: ClassVar[MessageType]
    params: ClassVar[type[Table] | None] = None
    """As the executor's: one table is for both."""

    def __init__(self, context: LevelContext) -> None:
        self.context = context

    def self_test(self) -> None:
        """Raise `LevelError` when the level must not start; the board then holds SYSFAIL."""

    def wanted(self, read: Ports, tick: int) -> bool:
        """Say, in well under a cycle, whether a plan is wanted now. Default: a command is new."""
        return bool(read.command.is_new)

    @abstractmethod
    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Make one plan into `write`. It takes effect `within_cycles` cycles after `tick`."""

    def close(self) -> None:
        """Release what the planner holds; called once, after the last plan."""
