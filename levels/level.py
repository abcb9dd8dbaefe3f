"""A level: an executor in every cycle and a planner in the background (fig. 1).

The author of a level writes `process` and `plan`. Pinning, timing, tracing, mailboxes and injected
faults belong to the board that runs the level. The author's other duties, each with its reason:

Every level
- `process` takes bounded time. It never waits, logs or prints, because the cycle has a deadline.
- An exception ends the board, which is restarted as a new process with a new object. State that
  must survive a restart is read back from your own mailboxes:
  `before = Input(MyStatus, "own.status")`.
- After a missed deadline the board calls `handle_missed_deadline`, which may bring the arm to rest.
- `tick` may advance by more than `context.every`, because cycles are skipped after a miss. Compute
  elapsed time from `tick` and never read a clock. Draw random numbers from `context.seed` and
  `tick`. Otherwise lockstep runs differ.
- Use `rack.levels.algebra` instead of `@`, `np.linalg`, `exp`, `arctan2` and similar functions,
  whose results differ in the last bit between processors.

Ports
- Ports are attributes of the class. The input from the level above is called `above`, the input
  from the level below `below`: `above = Input(TaskCommand, "above.command")`.
- An input is a `Reading` in every cycle, with `self.above.message` and its `verdict`. Before the
  first message all fields are 0 (`has_message` is False). Later it repeats the newest message
  (`is_new` is False). `is_lost` means that its writer is dead or silent. A level that moves the arm
  must then hold, and report the reason.
- `Inputs` reads the mailbox of every neighbour and maps each board to its `Reading`.
- An output is the message itself. Assign its fields: `self.status.state = State.EXECUTING`. It is
  written at the end of every cycle, and fields keep their values from cycle to cycle.
- A command names the input on which it is based, `Output(MoveCommand, rests_on=above)`, and a
  status likewise `rests_on=below`. Without it the response of the system cannot be measured.
- Messages that must not be missed, such as requests for motions, use a `QueuedOutput`. Fill its
  `message` and call `send()` for each message, several times in a cycle if necessary. `send()`
  returns False when the queue is full: try again in a later cycle. The only reader gets each
  message once and in order, the older unread ones in `Reading.earlier`, at most
  `max_messages(port)` in a cycle. Messages that a board has taken in the cycle in which it dies are
  lost. The sender notices this by the ids that the reader's status echoes.
- A mailbox of another rack that `[adapter.lan]` imports is read as `Input(Message, "lan.<port>")`.
  It is lost when its information is older than `max_age_ms`, and immediately when that rack is
  lost. `lan.peer_<rack>`, a `PeerPresence`, shows whether that rack is present.
- Ports that a config creates (`build_ports`) are in `self.ports`, by name.

Messages
- A message is a class: see `rack.backplane.message`. Reader and writer of a mailbox must name the
  same message and version. Increase the version with every change of the fields.
- Symbolic sizes of fields ("joints", "bodies", "state") follow from `[robot]` and `[scene]`, see
  `context.sizes`.
- A command derives from `Command`. Its `id` increases with every new command. 0 means no command.
- A status derives from `Status`, and its port is called `status`. It echoes the command's `id` and
  shows `state` in every cycle. The board with `ends_run` ends the run by DONE or ERROR. HOLDING
  (work is suspended) and ERROR need a one-line `reason`, which users see as the cause of a stall. A
  status whose `error` is not 0 at the end fails the run.

Operator: a level that accepts commands declares `operator = Input(OperatorCommand,
"own.operator")`, lists the commands in `commands`, and handles them with
`rack.levels.operator.Orders`. Its status derives from `AnsweringStatus` (`orders.fill_status`) and
its command from `RelayedCommand` (`command.operator = orders.find_basis(...)`). A level that
accepts none copies `operator` from the command above to its command and status. Otherwise the
system's response to an operator cannot be measured.

Events: declare what a level can detect, `contact = FindingKind(unit="N m", doc="the arm touches
something")`, and report it by `self.raise_finding("contact", 3.2, text="left finger")`. You may do
so in every cycle in which the level detects it. The run records one event for each episode.

Parameters: declare `params = MyParams`, a `Table`, and read it from `self.settings`. `rack check`
reports every mistake before the launch. The text below a field states its meaning and unit, and
`rack schema` shows it. Executor and planner of a board share one table. A field declared
`gain: Live[Positive] = 2.0`, which only the executor reads, may be set while the level runs (`rack
set`). `self.settings` has the new value in the next cycle, and a status that derives from
`AnsweringStatus` confirms it. A level that reads its operator's commands itself includes
`Operation.SET` among them, and calls `set_live`. A level that reads a program from `[task]`
declares `program = MyProgram`, a `Program`, in the same way.

Your own servo law derives from `rack.levels.servo.ServoLaw` and writes `torques`. A level that
drives an arm in another way derives from `ArmDriver`. Its status controls the level above:
- `holding`, `target` (where the arm is held) and `target_velocity` 0 until the first set point, and
  again when set points stop. The primitive level begins its motion at that `target`.
- `stopped`, and HOLDING with a `reason`, while it does not follow set points: the primitive level
  waits. The primitive level also holds motion when statuses are missing, or when a joint is farther
  from its `target` than its `following`.

A level whose decisions need no Python is a state table in a file: see
`rack.levels.systems.state_table.level`.

Your own primitive level writes set points that are due two of its cycles later (`due = tick + 2 *
every`). The first cycle brings them to the servo level, which interpolates during the second. It
reports `done`, `current`, `resting` and `blocked` of segments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType, ModuleType
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import model_validator

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.mailbox.queue import UNLIMITED
from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.compiled import preload
from rack.levels.errors import LevelError
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
    ConfiguredPorts,
    FindingKind,
    Input,
    InputPort,
    Inputs,
    Output,
    QueuedOutput,
    Sender,
    TimedOutput,
    WrittenPort,
    collect_ports,
)
from rack.levels.tables import (
    GoalConfig,
    RobotConfig,
    SceneConfig,
    Table,
    freeze_lists,
    list_live_keys,
    read_params,
    read_program,
    set_live,
)

__all__ = [
    "ConfiguredPorts",
    "Demand",
    "Executor",
    "Fault",
    "Finding",
    "FindingKind",
    "Input",
    "Inputs",
    "LevelContext",
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


Mismatches = Iterable[tuple[str, Any, str]]
"""Key, value and reason of each table entry that is inconsistent with something else."""


class Program(Table):
    """Base class for the record of a level that reads a program from `[task]`."""

    @model_validator(mode="before")
    @classmethod
    def _with_frozen_tables(cls, table: Any) -> Any:
        """Convert all lists to tuples, including lists in tables whose keys the user chooses."""
        return freeze_lists(table)

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield key, value and reason of each entry that is inconsistent with arm or scene.

        A key is the path of the entry, such as "action[0].object". `robot` is None for a rack
        without an arm.
        """
        return ()

    @classmethod
    def read(cls, table: Mapping[str, Any], robot: RobotConfig, scene: SceneConfig) -> Self:
        """Return the program in the `[task]` table.

        Args:
            table: The `[task]` table.
            robot: The `[robot]` table with which the program must agree.
            scene: The `[scene]` table with which the program must agree.

        Raises:
            ProgramError: The program is invalid. The text has one line per mistake.
        """
        return read_program(
            cls.model_validate,
            table,
            lambda program: program.find_mismatches(robot, scene),
            "task.",
        )

    def list_goals(self) -> Iterable[GoalConfig]:
        """Yield the final positions of the objects, in the order of the program.

        The positions are checked when the program reports that it is done.
        """
        return ()


class Pace(NamedTuple):
    """Cycle of a neighbouring level, the time allowed for a plan, and its parameters."""

    every: int  # ticks from cycle to cycle
    within_cycles: int  # cycles that one plan may take
    params: Mapping[str, Any] = MappingProxyType({})  # as in `LevelContext`


class Finding(NamedTuple):
    """A fault that a level has detected. Its board raises the alarm."""

    alarm: Alarm
    subject: int = -1  # joint, geom, ..., depending on the alarm. -1 for none in particular
    value: float = 0.0  # measured, in the unit of the alarm
    since: int | None = None  # tick at which it happened. None for the cycle that detected it
    text: str = ""  # details of a finding that the level has declared


@dataclass(frozen=True)
class LevelContext:
    """Data from the config that a level needs. Times are in ticks of the system clock."""

    board: str  # name of the board, and of the level
    every: int  # ticks from cycle to cycle
    within_cycles: int  # cycles that one plan may take
    clock_ns: int  # one tick, ns of simulated time
    seed: int  # of all random numbers
    robot: RobotConfig  # in a rack without an arm, no level uses it
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
        """Period of the level's cycle in s."""
        return self.every * self.clock_ns * 1e-9

    @property
    def tick_s(self) -> float:
        """Duration of one tick of the system clock in s."""
        return self.clock_ns * 1e-9


class PortOwner:
    """Common base class of levels and host programs."""

    inputs: ClassVar[Mapping[str, InputPort[Any, Any]]] = {}
    """The ports that it reads, by name, collected from the class and its bases."""
    outputs: ClassVar[Mapping[str, WrittenPort[Any, Any]]] = {}
    """The ports that it writes, by name, collected in the same way.

    A planner has the single port "plan".
    """
    params: ClassVar[type[Table] | None] = None
    """Keys of `[board.<name>.params]`, or of `[host.<name>.params]`, checked before the launch.

    Executor and planner share one table. None if the keys are not checked and the class reads them
    itself.
    """
    program: ClassVar[type[Program] | None] = None
    """Keys of `[task]`, checked before the launch.

    None if the class reads no program, or checks it itself.
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.inputs = collect_ports(cls, "inputs", InputPort)
        cls.outputs = collect_ports(cls, "outputs", WrittenPort)


class LevelSection(PortOwner):
    """Common base class of executors and planners."""

    preloads: ClassVar[tuple[ModuleType, ...]] = ()
    """Modules whose functions marked `compiled_for` every process of the level needs.

    See `rack.levels.compiled`.
    """

    settings: Any
    """The parameters, a record of the class `params`.

    A subclass may annotate it: `settings: MyParams`. It is replaced when a live parameter is set.
    """

    def __init__(self, context: LevelContext) -> None:
        self.context = context
        # In lockstep, time in s by which the clock is late for this cycle, set by the board.
        self.late_s = 0.0
        self.ports: dict[str, Any] = {}
        """Readings and messages of the ports that a config creates, by name."""
        if self.params is not None:
            self.settings = read_params(self.params, context.params)

    def find_input_table(self, port: str) -> dict[str, Any]:
        """Return the dictionary in which the board stores readings of `port`, keyed by port name.

        Raises:
            LevelError: The constructor uses the name of the port for something else.
        """
        if port not in self.inputs:
            return self.ports
        self._check_is_free(port)
        return vars(self)

    def store_output(self, port: str, value: object) -> None:
        """Store a message, or a `Sender`, as the attribute of an output port.

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
        """Check that the constructor has not used the name of a port for something else."""
        if not isinstance(vars(self).get(name, {}), Reading | Message | dict):
            raise LevelError(
                f"class {type(self).__name__}: attribute '{name}' has the name of a port; rename"
                " the attribute"
            )

    @classmethod
    def preload(cls) -> None:
        """Load resources that every process of the level needs, such as compiled code.

        Called once, before the crate forks.
        """
        preload(*cls.preloads)

    def self_test(self) -> None:
        """Raise `LevelError` if the level must not start.

        If it raises an error, the board keeps SYSFAIL asserted, and the launch fails.
        """

    def max_messages(self, port: str) -> int:
        """Return the maximum number of messages to take from each queue that `port` reads.

        Called before each read. By default, there is no maximum.
        """
        return UNLIMITED

    def close(self) -> None:
        """Release resources of the level. Called once, after the last cycle or plan."""


OPERATOR = Input(OperatorCommand, "own.operator")
"""Port of a level that an operator may command: `operator = OPERATOR`."""
OPERATOR_PORT = Input(OperatorCommand, "own.operator")
"""Port by which a board sets live parameters of a level that does not declare `operator`."""
OPERATOR_PORT.name = "operator"


class Executor(LevelSection, ABC):
    """The foreground part of a level. It runs in every cycle, at high priority and in bounded time.

    Subclasses declare their ports and write `process`. Output messages keep their values from cycle
    to cycle. Each is written to its mailbox `<board>.<port>` at the end of every cycle.
    """

    faults: ClassVar[tuple[type, ...]] = ()
    """Classes of steps by which faults can affect what the level drives.

    See `rack.levels.fault_steps`.
    """
    commands: ClassVar[Commands] = {}
    """Operator's commands that the level accepts, with the forms of their goals.

    For levels that read "own.operator".
    """
    finding_kinds: ClassVar[Mapping[str, FindingKind]] = {}
    """Findings that the level may raise, by name, collected from the class and its bases."""
    last_constructed: ClassVar[Executor | None] = None
    """The executor that was constructed last in this process.

    A board constructs one executor, which then constructs what it drives.
    """

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        # Board and level exchange these in addition to the ports. The board sets `demand` before
        # each `process`, and reports and clears `findings` and `acted` after it. It calls `inject`
        # when the active faults change.
        # Kind of stop that the rack demands of the arm in this cycle, for safety.
        self.demand = Demand.NONE
        # Faults detected in this cycle, once per episode. The board raises alarms for them.
        self.findings: list[Finding] = []
        # The injected faults that had an effect in this cycle, by index. The value is True if the
        # effect was large enough that it must be detected.
        self.acted: dict[int, bool] = {}
        # Callbacks of the driven arm or hand, called at the end of each cycle with its `ArmState`.
        self.complete_cycle: list[Callable[[ArmState | None], None]] = []
        self._orders = Orders(self.commands)
        Executor.last_constructed = self

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.finding_kinds = collect_ports(cls, "finding_kinds", FindingKind)
        for name, kind in cls.finding_kinds.items():
            if kind.mistake:
                raise LevelError(f"class {cls.__name__}: finding '{name}' {kind.mistake}")
        if "operator" not in cls.inputs and list_live_keys(cls.params):
            if hasattr(cls, "operator"):
                raise LevelError(
                    f"class {cls.__name__}: attribute 'operator' has the name of the port that sets"
                    " live parameters; rename the attribute"
                )
            cls.inputs = {**cls.inputs, OPERATOR_PORT.name: OPERATOR_PORT}
            cls.commands = {Operation.SET: ()}

    def raise_finding(
        self, name: str, value: float = 0.0, *, unit: str = "", text: str = ""
    ) -> None:
        """Report something that the level has detected, as an event of the run.

        A finding that is raised again within 20 cycles continues its episode and makes no new
        event.

        Args:
            name: Name of one of the class's `FindingKind`s.
            value: The measured value, in the declared unit.
            unit: The unit of `value`, to have it checked against the declaration. Not checked if
                empty.
            text: Details of this finding, in a few words. Text beyond 144 bytes is cut.

        Raises:
            LevelError: The class declares no such finding, or declares it with another unit.
        """
        kind = self.finding_kinds.get(name)
        subject = f"class {type(self).__name__}: finding '{name}' is"
        if kind is None:
            matches = get_close_matches(name, self.finding_kinds, 1)
            known = ", ".join(self.finding_kinds) or "none"
            hint = f"did you mean '{matches[0]}'?" if matches else f"declared: {known}"
            raise LevelError(f"{subject} not declared; {hint}")
        if unit and unit != kind.unit:
            raise LevelError(f"{subject} in {kind.unit}, not in {unit}")
        number = list(self.finding_kinds).index(name)
        self.findings.append(Finding(Alarm.OWN, number, float(value), text=text))

    @property
    def is_set_by_board(self) -> bool:
        """True if the board, rather than the level, sets live parameters for the operator."""
        return self.inputs.get(OPERATOR_PORT.name) is OPERATOR_PORT

    def take_settings(self, tick: int) -> None:
        """Set live parameters as the operator commands, and answer in the status.

        Called by the board before `process`. There is no answer if the status does not derive from
        `AnsweringStatus`.
        """
        self._orders.take_commands(OPERATOR_PORT.__get__(self, type(self)), self._set_parameter)
        status = vars(self).get("status")
        if isinstance(status, AnsweringStatus):
            self._orders.fill_status(status)

    def _set_parameter(self, command: OperatorCommand) -> None:
        """Set the live parameter that a command names, or refuse the command."""
        self.settings, why = set_live(self.settings, command.name)
        if why:
            self._orders.refuse_newest(why)

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names to which alarms refer by index, such as control modifications.

        By default there are none. `list_operation_names` returns the same names unless a subclass
        overrides it. `params` may be invalid.
        """
        return ()

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield key of `[board.<name>]`, value and reason of each inconsistent parameter.

        Called before the launch, with parameters that are valid by themselves. `context.above` and
        `context.below` give the parameters of the neighbouring levels.
        """
        return ()

    @classmethod
    def list_operation_names(
        cls, what: Operation, params: Mapping[str, Any], scene: SceneConfig
    ) -> Sequence[str]:
        """Return the names that an operator may give with an operation.

        See `rack.levels.operator.NAMED_OPERATIONS`.

        Args:
            what: The operation.
            params: Parameters of the level.
            scene: The `[scene]` table.
        """
        return cls.list_names(params)

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        """Return the ports that a board's parameters add to the ports of the class.

        Args:
            params: Parameters of the level, which may be invalid.
            types: Message classes of the mailboxes that classes declare, keyed by mailbox.
        """
        return ConfiguredPorts()

    @classmethod
    def find_standby_obstacle(cls, params: Mapping[str, Any]) -> str:
        """Return why the level cannot have a standby. Empty if it can.

        Called before the launch. A level that drives an arm or a hand needs an output `state`, from
        which the simulation of a standby is realigned. `params` may be invalid.
        """
        if cls.faults and "state" not in cls.outputs:
            return f"class {cls.__name__} has no output 'state', from which a standby is realigned"
        return ""

    def realign(self, state: Message) -> None:
        """Continue from `state`, the message that the active copy has written in its last cycle.

        Called in a standby before a cycle, after it or the active copy has missed one. By default,
        do nothing, which suits a level whose messages follow from its inputs.
        """

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the injected faults. `faults` contains all faults that are now active."""

    def handle_missed_deadline(self, tick: int, skipped: int) -> None:
        """React to a missed deadline, before the first cycle after it reads its inputs.

        By default, do nothing.

        Args:
            tick: Release tick of that cycle.
            skipped: Number of releases skipped before it. 0 if the last cycle ended too late, but
                before the next release expired.
        """

    @abstractmethod
    def process(self, tick: int) -> None:
        """Compute the cycle released at `tick`: read the inputs and fill the outputs."""


class Planner(LevelSection, ABC):
    """The background part of a level. It plans ahead, at low priority.

    Each plan must be ready within `within_cycles` cycles. A planner runs in a separate process and
    shares nothing with the executor except mailboxes. Its single output is its mailbox
    `<board>.plan`, which may be a queue: `output = QueuedOutput(MyPlan)`.
    """

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # The mailbox is called `plan`, whatever the attribute is called.
        cls.outputs = {"plan": plan} if (plan := cls.outputs.get("output")) is not None else {}

    def wanted(self, tick: int) -> bool:
        """Return True if a plan has to be computed now.

        The check must take much less than a cycle. By default, a plan is computed for each new
        command.
        """
        command: Reading[Message] = getattr(self, "above")  # noqa: B009
        return command.is_new

    @abstractmethod
    def plan(self, tick: int) -> None:
        """Compute a plan and write it to `output`. It takes effect `within_cycles` cycles later."""
