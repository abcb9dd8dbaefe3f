"""A level: an executor every cycle and a planner in the background (fig. 1), and the duties of its
author.

The author writes `process` and `plan`. Pinning, timing, tracing, mailboxes and injected faults
belong to the board that runs the level. The other duties, each with its reason:

Every level
- `process` takes bounded time: it never waits, logs or prints. The cycle has a deadline.
- An exception ends the board, which is restarted as a new process with a new object. State that
  must survive this is read back from your own mailboxes: `before = Input(MyStatus, "own.status")`.
- `tick` may advance by more than `context.every`: cycles are skipped after a miss. Compute elapsed
  time from it; never read a clock, and take randomness from `context.seed` and `tick`. Otherwise
  lockstep runs differ.
- Use `rack.levels.algebra` in place of `@`, `np.linalg`, `exp`, `arctan2` and the like: those
  differ in the last bit between processors.

Ports
- Ports are attributes of the class. The input of the level above is called `above`, that of the
  level below `below`: `above = Input(TaskCommand, "above.command")`.
- An input is a `Reading` in every cycle: `self.above.message` and its `verdict`. Before the first
  message all fields are 0 (`is_there` is False); later it repeats the newest one (`is_new` is
  False). `is_lost`: its writer is dead or silent. A level that moves the arm then holds, and
  reports the reason.
- `Inputs` reads the mailbox of every neighbour, and is a mapping from board to `Reading`.
- An output is the message itself: assign its fields, `self.status.state = State.EXECUTING`. It is
  written at the end of every cycle; fields keep their values from cycle to cycle.
- A command names the input on which it rests, `Output(MoveCommand, rests_on=above)`, and a status
  likewise `rests_on=below`: without it the response of the system cannot be measured.
- Messages of which none may be missed, such as requests for motions, go through a `QueuedOutput`:
  fill its `message` and call `send()` for each, several in a cycle if need be. `send()` returns
  False when the queue is full; try again in a later cycle. The only reader gets each message once
  and in order, the older unread ones in `Reading.earlier`, at most `room(port)` in a cycle. What a
  board has taken in the cycle in which it dies is lost with it: the sender notices by the ids that
  the reader's status echoes.
- A mailbox of another rack, which `[adapter.lan]` imports, is read as `Input(Message,
  "lan.<port>")`. It is lost when its information is older than `max_age_ms`, and at once when that
  rack is. `lan.peer_<rack>`, a `PeerPresence`, shows whether that rack is there.
- Ports that a config makes (`made_ports`) are in `self.ports`, by name.

Messages
- A message is a class: see `rack.backplane.message`. Reader and writer of a mailbox must name the
  same message and version. The version rises with every change of the fields.
- Symbolic sizes of fields ("joints", "bodies", "state") follow from `[robot]` and `[scene]`, see
  `context.sizes`.
- A command derives from `Command`. Its `id` rises with every new command; 0: no command.
- A status derives from `Status`, and its port is called `status`. It echoes the command's `id` and
  shows `state` in every cycle: the board with `ends_run` ends the run by DONE or ERROR; HOLDING
  (kept from its work) and ERROR need a `reason` of one line, which users see as the cause of a
  stall. A status whose `error` is not 0 at the end fails the run.

Operator: a level that takes commands declares `operator = Input(OperatorCommand, "own.operator")`,
lists them in `commands`, and follows with `rack.levels.operator.Orders`. Its status derives from
`AnsweringStatus` (`orders.report`) and its command from `RelayedCommand` (`command.operator =
orders.rests_on(...)`). A level that takes none copies `operator` from the command above to its own
command and status: without it the system's response to an operator cannot be measured.

Events: what a level finds by itself is declared, `contact = FindingKind(unit="N m", doc="the arm
touches something")`, and reported by `self.raise_finding("contact", 3.2, text="left finger")`, in
every cycle in which it holds if you like: the run records one event for each episode.

Parameters: declare `params = MyParams`, a `Table`, and find it in `self.settings`: `rack check`
reports every mistake before the launch. The text below a field says what it means, with its
unit: `rack schema` shows it. Executor and planner of a board share one table. A field declared
`gain: Live[Positive] = 2.0`, which the executor alone reads, may be set while the level runs (`rack
set`): `self.settings` has the new value in the next cycle, and a status that derives from
`AnsweringStatus` confirms it. A level that reads its operator's commands itself takes
`Operation.SET` among them, and calls `set_live`. A level that reads a program from `[task]`
declares `program = MyProgram`, a `Program`, likewise.

A servo law of your own derives from `rack.levels.servo.ServoLaw` and writes `torques`. A level that
drives an arm otherwise derives from `ArmDriver`, and what it reports moves the level above:
- `holding`, `target` (where the arm is held) and `target_velocity` 0 until the first set point, and
  again when set points stop: the primitive level begins its motion at that `target`.
- `stopped`, and HOLDING with a `reason`, while it does not follow set points: the primitive level
  waits. It also holds motion when statuses are missing, or when a joint is farther from its
  `target` than its `following`.

A level without Python of its own for its decisions is a state table in a file: see
`rack.levels.systems.state_table.level`.

A primitive level of your own writes set points due two of its cycles later (`due = tick + 2 *
every`): the first brings them to the servo, which interpolates over the second. It reports `done`,
`current`, `resting` and `blocked` of segments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import ValidationError, model_validator

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.mailbox.queue import ALL
from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.compiled import preload
from rack.levels.errors import LevelError, ProgramError
from rack.levels.fault_steps import Fault
from rack.levels.messages import ArmState
from rack.levels.operator import (
    AnsweringStatus,
    Commands,
    Operation,
    OperatorCommand,
    Orders,
)
from rack.levels.ports import (
    FindingKind,
    Input,
    InputPort,
    Inputs,
    MadePorts,
    Output,
    QueuedOutput,
    Sender,
    TimedOutput,
    collect_ports,
)
from rack.levels.tables import (
    GoalConfig,
    RobotConfig,
    SceneConfig,
    Table,
    frozen,
    live_keys,
    read_params,
    set_live,
)

__all__ = [
    "Demand",
    "Executor",
    "Fault",
    "Finding",
    "FindingKind",
    "Input",
    "Inputs",
    "LevelContext",
    "MadePorts",
    "Output",
    "Pace",
    "Planner",
    "Program",
    "QueuedOutput",
    "Reading",
    "Sender",
    "TimedOutput",
    "Verdict",
]


Misfits = Iterable[tuple[str, Any, str]]
"""Key, value and reason of each entry of a table that does not suit something else."""


class Program(Table):
    """Base of the record of a level that reads a program from `[task]`."""

    @model_validator(mode="before")
    @classmethod
    def _with_frozen_tables(cls, table: Any) -> Any:
        """Freeze the lists in tables by names of the user's own, too."""
        return frozen(table)

    def misfits(self, robot: RobotConfig | None, scene: SceneConfig) -> Misfits:
        """Yield key, as in "action[0].object", value and reason of each entry that does not suit
        arm or scene.
        """
        return ()

    @classmethod
    def read(cls, table: Mapping[str, Any], robot: RobotConfig, scene: SceneConfig) -> Self:
        """Return the program in the `[task]` table. Raises `ProgramError`, with one line per
        mistake.
        """
        try:
            program = cls.model_validate(table)
        except ValidationError as error:
            lines = [
                f"task.{'.'.join(map(str, entry['loc']))}: {entry['msg']}"
                for entry in error.errors()
            ]
            raise ProgramError("\n".join(lines)) from error
        if misfits := [
            f"task.{key} = {value!r}: {why}" for key, value, why in program.misfits(robot, scene)
        ]:
            raise ProgramError("\n".join(misfits))
        return program

    def goals(self) -> Iterable[GoalConfig]:
        """Yield where the program takes objects, in its order: checked when it says that it is
        done.
        """
        return ()


class Pace(NamedTuple):
    """The rhythm of a level."""

    every: int  # ticks from cycle to cycle
    within_cycles: int  # cycles that one plan may take


class Finding(NamedTuple):
    """A fault that a level has found; its board raises the alarm. See
    `rack.backplane.watch.alarms.Alarm`.
    """

    alarm: Alarm
    subject: int = -1  # joint, geom, ...: by alarm; -1: none in particular
    value: float = 0.0  # measured, in the unit of the alarm
    since: int | None = None  # tick at which it happened, if that is not the cycle that found it
    text: str = ""  # of one that the level has declared


@dataclass(frozen=True)
class LevelContext:
    """The rack as a level knows it, from the config. Times are ticks of the system clock."""

    board: str  # name of the board, and of the level
    every: int  # ticks from cycle to cycle
    within_cycles: int  # cycles that one plan may take
    clock_ns: int  # one tick, ns of simulated time
    seed: int  # of all random numbers
    robot: RobotConfig  # a rack without an arm has levels that do not ask for it
    scene: SceneConfig
    task: Mapping[str, Any]  # `[task]`
    sizes: Mapping[str, int]  # symbolic sizes of messages by name
    above: Mapping[str, Pace] = field(default_factory=dict)  # boards of the level above, by name
    below: Mapping[str, Pace] = field(default_factory=dict)  # boards of the level below, by name
    params: Mapping[str, Any] = field(default_factory=dict)  # `[board.<name>.params]`, as given
    phase: int = 0  # first tick of the level, less than `every`
    rack: str = ""  # name of the rack

    @property
    def period_s(self) -> float:
        """The level's cycle, in s."""
        return self.every * self.clock_ns * 1e-9

    @property
    def tick_s(self) -> float:
        """One tick of the system clock, in s."""
        return self.clock_ns * 1e-9


class LevelSection:
    """What executor and planner of a level have in common."""

    inputs: ClassVar[Mapping[str, InputPort[Any]]] = {}
    """The ports that it reads, by name: collected from the class and its bases."""
    outputs: ClassVar[Mapping[str, Output[Any]]] = {}
    """The ports that it writes, likewise; of a planner the one port "plan"."""
    params: ClassVar[type[Table] | None] = None
    """Keys of `[board.<name>.params]`, checked before the launch; executor and planner share one
    table. None: unchecked, the level reads them by itself."""
    program: ClassVar[type[Program] | None] = None
    """Keys of `[task]`, checked before the launch; None: the level reads no program, or checks it
    by itself."""
    preloads: ClassVar[tuple[ModuleType, ...]] = ()
    """Modules of which every process of the level needs the functions marked `compiled_for`: see
    `rack.levels.compiled`."""

    settings: Any
    """The parameters: a record of the class `params`, as which a subclass may annotate it,
    `settings: MyParams`. Replaced by a new one when a live parameter is set."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.inputs = collect_ports(cls, "inputs", (InputPort,))
        cls.outputs = collect_ports(cls, "outputs", (Output,))

    def __init__(self, context: LevelContext) -> None:
        self.context = context
        self.ports: dict[str, Any] = {}
        """What the board puts into the ports that a config makes, by name."""
        if self.params is not None:
            self.settings = read_params(self.params, context.params)

    def input_table(self, port: str) -> dict[str, Any]:
        """Return the dict into which the board puts what it has read from a port, by name.

        Raises:
            LevelError: The constructor uses the name of the port for something else.
        """
        if port not in self.inputs:
            return self.ports
        self._check_is_free(port)
        return vars(self)

    def place_output(self, port: str, value: object) -> None:
        """Put a message, or a `Sender`, where the level finds it under the name of a port.

        Raises:
            LevelError: The constructor uses that name for something else.
        """
        if port not in self.outputs:
            self.ports[port] = value
            return
        name = self.outputs[port].name
        self._check_is_free(name)
        vars(self)[name] = value

    def _check_is_free(self, name: str) -> None:
        if not isinstance(vars(self).get(name, {}), Reading | Message | dict):
            why = f"attribute '{name}' has the name of a port; rename the attribute"
            raise LevelError(f"class {type(self).__name__}: {why}")

    @classmethod
    def preload(cls) -> None:
        """Load what every process of the level needs, such as compiled code. Called once, before
        the crate forks.
        """
        preload(*cls.preloads)

    def self_test(self) -> None:
        """Raise `LevelError` when the level must not start: the board then holds SYSFAIL, and the
        launch fails.
        """

    def room(self, port: str) -> int:
        """Return how many messages to take from each queue that `port` reads, asked before each
        read. Default: all.
        """
        return ALL

    def close(self) -> None:
        """Release what the level holds; called once, after the last cycle, or plan."""


OPERATOR = Input(OperatorCommand, "own.operator")
"""The port by which the board of a level without one of that name sets its live parameters."""
OPERATOR.name = "operator"


class Executor(LevelSection, ABC):
    """The foreground of a level: runs every cycle, at high priority, in bounded time.

    Subclasses declare their ports and write `process`. Output messages keep their values from cycle
    to cycle; each is written to its mailbox `<board>.<port>` at the end of every cycle.
    """

    faults: ClassVar[tuple[type, ...]] = ()
    """Classes of steps by which faults can strike what the level drives: see
    `rack.levels.fault_steps`."""
    commands: ClassVar[Commands] = {}
    """An operator's commands to the level, with the forms of their goals; for a level that reads
    "own.operator"."""
    finding_kinds: ClassVar[Mapping[str, FindingKind]] = {}
    """What it may find, by name: collected from the class and its bases."""
    made_last: ClassVar[Executor | None] = None
    """In this process. A board makes one executor, which then makes what it drives."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        # In addition to the ports, these pass between board and level. The board sets `demand`
        # before each `process`, and reports and clears `findings` and `acted` after it. It calls
        # `inject` when the active faults change.
        self.demand = Demand.NONE  # stop that the rack's safety demands of the arm in this cycle
        self.findings: list[
            Finding
        ] = []  # faults found in this cycle, once per episode: the board raises alarms
        # The injected faults that changed anything in this cycle, by index; whether each showed:
        # then it must be found.
        self.acted: dict[int, bool] = {}
        # Whatever it drives adds its own findings, and completes each cycle, given its `ARM_STATE`.
        self.complete_cycle: list[Callable[[ArmState | None], None]] = []
        self._live_orders = Orders(self.commands)
        Executor.made_last = self

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.finding_kinds = collect_ports(cls, "finding_kinds", (FindingKind,))
        for name, kind in cls.finding_kinds.items():
            if kind.mistake:
                raise LevelError(f"class {cls.__name__}: finding '{name}' {kind.mistake}")
        if "operator" not in cls.inputs and live_keys(cls.params):
            if hasattr(cls, "operator"):
                why = "attribute 'operator' has the name of the port that sets live parameters"
                raise LevelError(f"class {cls.__name__}: {why}; rename the attribute")
            cls.inputs = {**cls.inputs, OPERATOR.name: OPERATOR}
            cls.commands = {Operation.SET: ()}

    def raise_finding(
        self, name: str, value: float = 0.0, *, unit: str = "", text: str = ""
    ) -> None:
        """Report something that the level has found, as an event of the run.

        A finding that is raised again within 20 cycles continues its episode, and is no other
        event.

        Args:
            name: One of the class's `FindingKind`s.
            value: What was measured, in the unit declared.
            unit: That unit, if it shall be checked.
            text: What is special about this one, in a few words; beyond 144 bytes it is cut.

        Raises:
            LevelError: The class declares no such finding, or another unit for it.
        """
        kind = self.finding_kinds.get(name)
        what = f"class {type(self).__name__}: finding '{name}' is"
        if kind is None:
            near = get_close_matches(name, self.finding_kinds, 1)
            known = ", ".join(self.finding_kinds) or "none"
            hint = f"did you mean '{near[0]}'?" if near else f"declared: {known}"
            raise LevelError(f"{what} not declared; {hint}")
        if unit and unit != kind.unit:
            raise LevelError(f"{what} in {kind.unit}, not in {unit}")
        number = list(self.finding_kinds).index(name)
        self.findings.append(Finding(Alarm.OWN, number, float(value), text=text))

    @property
    def is_set_by_board(self) -> bool:
        """Whether it has live parameters, and leaves the operator's commands to its board."""
        return self.inputs.get(OPERATOR.name) is OPERATOR

    def take_settings(self, tick: int) -> None:
        """Set live parameters as their operator commands, and answer in a status that can. Called
        by the board before `process`.
        """
        self._live_orders.take(OPERATOR.__get__(self, type(self)), self._set)
        status = vars(self).get("status")
        if isinstance(status, AnsweringStatus):
            self._live_orders.report(status)

    def _set(self, command: OperatorCommand) -> None:
        self.settings, why = set_live(self.settings, command.name)
        if why:
            self._live_orders.refuse(why)

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return what an operator's settings, and alarms of the level by number, name; `params` may
        be invalid.
        """
        return ()

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield key of `[board.<name>]`, value and reason of each disagreement with the neighbours,
        before the launch.

        The parameters of all boards concerned are valid, each by itself.
        """
        return ()

    @classmethod
    def wording(
        cls, what: Operation, params: Mapping[str, Any], scene: SceneConfig
    ) -> Sequence[str]:
        """Return the names that an operator may give with an operation; see
        `rack.levels.operator.NAMED`.
        """
        return cls.names(params)

    @classmethod
    def made_ports(cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]) -> MadePorts:
        """Return the ports that `params`, which may have mistakes, makes; `types`: mailboxes that
        classes declare.
        """
        return MadePorts()

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the injected faults by `faults`, all those active from now on."""

    @abstractmethod
    def process(self, tick: int) -> None:
        """Compute one cycle, released at `tick`: read the inputs, fill the outputs."""


class Planner(LevelSection, ABC):
    """The background of a level: plans ahead, at low priority, within `within_cycles` cycles.

    It runs in a separate process and shares nothing with the executor but mailboxes. Its one output
    is its mailbox `<board>.plan`, which may be a queue: `output = QueuedOutput(MyPlan)`.
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # Its mailbox is called after the plan.
        cls.outputs = {"plan": plan} if (plan := cls.outputs.get("output")) is not None else {}

    def wanted(self, tick: int) -> bool:
        """Return, in well under a cycle, whether a plan is wanted now. Default: a command is
        new.
        """
        command: Reading[Message] = getattr(self, "above")  # noqa: B009  # a port of most
        return command.is_new

    @abstractmethod
    def plan(self, tick: int) -> None:
        """Make one plan into the output. It takes effect `within_cycles` cycles after `tick`."""
