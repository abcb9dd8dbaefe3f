"""Tables of a rack's config: every key with its unit, range and meaning.

`rack.levels.tables` declares `[robot]` and `[scene]`. The classes of the levels declare the keys of
`[task]` and `[board.<name>.params]`. The text below a field is its meaning, with the unit in
brackets; `rack schema` shows the unit in a separate column.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, model_validator

from rack.backplane.clock.system_clock import compute_period_ticks
from rack.backplane.layout import Role, TaskSpec, Wake
from rack.boards.config.command import CommandConfig
from rack.boards.config.files import LAN_ADAPTER, STATE_TABLES, change_texts, shorten_path
from rack.boards.config.protocols import ProtocolConfig
from rack.boards.config.record import RecordConfig
from rack.boards.config.times import (
    SHORTEST_MS,
    BudgetConfig,
    ScheduleConfig,
    TimingConfig,
    TransferConfig,
)
from rack.boards.config.toml import to_toml
from rack.boards.faults.config import FaultConfig
from rack.boards.lan.config import LanTable
from rack.levels.tables import (
    ClassName,
    MailboxName,
    Positive,
    RackName,
    RobotConfig,
    SceneConfig,
    Table,
    to_tuple,
)

CLOCK_SLOT = 1
"""Slot of the system controller, as on VME."""
LAST_SLOT = 21
OUTSIDE = 0
"""Slot number of host boards, which have no slot."""
ANY_CORE = -1
"""Core number of host boards, which are not pinned to a core."""

Coupling = Literal["tight", "loose", "none"]
Mode = Literal["realtime", "lockstep"]
OnLoss = Literal["hold", "stop", "brake"]


Standbys = Annotated[tuple["StandbyConfig", ...], BeforeValidator(to_tuple)]
Neighbours = Annotated[tuple[str, ...], BeforeValidator(to_tuple)]
Sources = Annotated[tuple[MailboxName, ...], BeforeValidator(to_tuple)]
Slot = Annotated[int, Field(ge=CLOCK_SLOT + 1, le=LAST_SLOT)]
Core = Annotated[int, Field(ge=0, le=1023)]
Priority = Annotated[int, Field(ge=0, le=99)]
Restarts = Annotated[int, Field(ge=0, le=10_000)]
RESTART_S = 2.0
"""Longest time of a restart in real time. A planner with its libraries needs 1.5 s."""
LONGEST_EVERY = 1_000_000
"""Longest cycle of a board in ticks."""


SchedulerName = Literal["fixed-priority", "earliest-deadline-first", "maximum-urgency-first"]


class StandbyConfig(Table):
    """`[board.<name>] standby`, `[clock] standby`: place of a further copy.

    See `rack.backplane.standby`.
    """

    slot: Slot
    """slot in the crate"""
    core: Core = 0
    """core of the copy; this machine must have it"""
    priority: Priority | None = None
    """SCHED_FIFO priority of the copy; default: the board's"""


class ClockConfig(Table):
    """`[clock]`: system clock and its board, the system controller in slot 1."""

    scheduler: SchedulerName | None = None
    """how boards compete for their cores; fixed-priority, the default: SCHED_FIFO with the boards'
    priorities; earliest-deadline-first: SCHED_DEADLINE by the boards' cycles, with twice their
    budgets reserved; maximum-urgency-first: critical boards precede others, then the least laxity
    counts (lockstep only); if a config names one, an operator may change it while the rack runs"""
    on_no_realtime: Literal["refuse", "warn"] = "warn"
    """whether to warn or to refuse the launch if the system refuses a SCHED_FIFO priority or
    exclusive cores"""
    period_ms: float = Field(ge=SHORTEST_MS, le=1000, allow_inf_nan=False)
    """tick period [ms]; a whole number of ns"""
    mode: Mode = "realtime"
    """realtime: ticks follow wall-clock time; lockstep: a tick begins when every task is done"""
    speed: float = Field(1.0, ge=0.001, le=1000, allow_inf_nan=False)
    """simulated time divided by real time; 2 runs twice as fast"""
    wake: Wake = "timer"
    """how boards wait for their next cycle: timer: each sleeps until its next release; signal: the
    clock wakes them; poll: busy-wait"""
    idle_cores: Literal["sleep", "awake"] = "sleep"
    """whether idle cores sleep in real time; awake needs root and makes wake-ups about 20 us
    earlier on bare metal, but a virtual machine may lose its cores for ms; see rack bench
    machine"""
    core: Core = 0
    """core of the system controller"""
    exclusive_cores: bool = False
    """in real time, keep other processes off the rack's cores by a cgroup (version 2) for each;
    needs root, and a core that the rack does not use; see on_no_realtime"""
    priority: Priority = 0
    """SCHED_FIFO priority of the system controller; 0 means ordinary scheduling"""
    standby: StandbyConfig | None = None
    """further process that continues the clock when the first one is lost"""


class ExchangeConfig(Table):
    """`[board.<name>.exchange.<port>]`: when the executor reads a port; default: every cycle."""

    every: int = Field(1, ge=1, le=LONGEST_EVERY)
    """the port is read in every n-th cycle and keeps its message in between"""
    phase: int = Field(0, ge=0)
    """number of the first cycle that reads the port, less than every [cycles]"""
    asynchronous: bool = False
    """read the newest message as soon as it is written; real-time runs then differ"""


class SupervisionConfig(Table):
    """`[supervision]`: restarts of boards that die or hang, and cycles that a level may lose.

    When no restarts are left, the brakes stay engaged.
    """

    restarts: Restarts = 5
    """maximum number of restarts of one task within within_s; with 0 it is never restarted"""
    within_s: Positive = 10.0
    """time window in which restarts are counted [s]; simulated time"""
    lockstep_restart_s: Positive = 0.5
    """simulated time after which a lost task returns in lockstep [s]; in real time it returns when
    it is ready"""
    lockstep_end_s: Positive = 3600.0
    """simulated time after which a run in lockstep fails if the level that ends it reports neither
    done nor error [s]; `rack run --seconds` replaces it"""
    max_missed_fraction: float = Field(0.05, ge=0, le=1)
    """largest fraction of its cycles that a level may miss or skip in a successful run, rounded up
    to whole cycles; cycles due during an injected fault or the recovery from it do not count; 1: no
    limit"""

    def find_restart_time(self, lockstep: bool) -> float:
        """Return the longest simulated time in s allowed for a restart."""
        return self.lockstep_restart_s if lockstep else max(RESTART_S, self.lockstep_restart_s)


class PlacedConfig(Table):
    """Keys that boards of levels and the board of the network adapter have in common."""

    slot: Slot
    """slot in the crate; slot 1 is the clock's"""
    core: Core = 0
    """core of the board; another core is used if the machine does not have it"""
    priority: Priority = 0
    """SCHED_FIFO priority of the executor; 0 means ordinary scheduling"""
    budget: BudgetConfig | None = None
    """worst-case processor times, for the timing model"""
    restarts: Restarts | None = None
    """overrides supervision.restarts for this board's tasks"""
    restarts_within_s: Positive | None = None
    """overrides supervision.within_s for this board's tasks [s]"""


class BoardConfig(PlacedConfig):
    """`[board.<name>]`: one processor of the rack, its level, and its wiring."""

    rate_hz: Positive | None = Field(None, ge=1e-6)
    """rate of the executor [Hz]; must divide the clock rate; give either rate_hz or every"""
    every: int | None = Field(None, ge=1, le=LONGEST_EVERY)
    """period of the executor [ticks]; instead of rate_hz"""
    phase: int = Field(0, ge=0)
    """tick of the board's first release, less than its period [ticks]"""
    wake: Wake | None = None
    """how this board waits for its next cycle; default: clock.wake"""
    above: Neighbours = ()
    """board of the level above, or a list; this level reads its commands"""
    below: Neighbours = ()
    """board of the level below, or a list; this level reads its status"""
    executor: ClassName
    """class of the executor, package.module:Class"""
    planner: ClassName | None = None
    """class of the planner, package.module:Class"""
    coupling: Coupling = "none"
    """tight: planner on this board; loose: on its own board; none: no planner"""
    within_cycles: int = Field(1, ge=1, le=10_000)
    """time allowed for one plan [cycles]"""
    planner_slot: Slot | None = None
    """slot of a loosely coupled planner"""
    planner_core: Core | None = None
    """core of a loosely coupled planner; default: the board's core"""
    planner_priority: Priority = 0
    """SCHED_FIFO priority of the planner; 0 means ordinary scheduling"""
    reads: dict[str, Sources] = {}
    """mailbox by port of the executor, or a list; overrides the sources that the level declares"""
    planner_reads: dict[str, Sources] = {}
    """mailbox by port of the planner, or a list; as reads"""
    exchange: dict[str, ExchangeConfig] = {}
    """when the executor reads a port, by port; the ages of all its messages are recorded"""
    params: dict[str, Any] = {}
    """parameters of the level, declared by its class"""
    scheduler: SchedulerName | None = None
    """how the executor competes for its core; default: clock.scheduler; on one core,
    maximum-urgency-first precedes earliest-deadline-first, and this fixed-priority"""
    critical: bool = False
    """maximum-urgency-first runs critical boards before others"""
    transfer: TransferConfig = TransferConfig()
    """emulation of a slower bus for this board"""
    standby: Standbys = ()
    """further copy of the executor, which takes over its mailboxes when it is lost, or a list"""
    compare: bool = False
    """raise an alarm, one cycle later, when a standby computes other messages; the level must be
    deterministic"""
    vote: bool = False
    """with two standbys: the copy that differs from the two others is taken out and restarted"""
    ends_run: bool = False
    """end the run when this level's status is done or error"""
    on_loss: OnLoss = "hold"
    """reaction to the loss of this board; hold: the level below holds; stop: the arm ramps to rest,
    then brakes; brake: the arm brakes at once"""

    @property
    def busy_ms(self) -> float:
        """Budgeted processor time of one executor cycle in ms. 0 without a budget."""
        cost = self.budget
        if cost is None:
            return 0.0
        return cost.exchange_ms + cost.read_ms + cost.process_ms + cost.write_ms

    @property
    def planning_ms(self) -> float:
        """Budgeted processor time of one plan in ms. 0 without a budget."""
        return 0.0 if self.budget is None else self.budget.plan_ms + self.budget.update_ms


LAN = "lan"
"""Name of the board that exchanges mailboxes with other racks."""


class LanConfig(PlacedConfig, LanTable):
    """`[adapter.lan]`: board that exchanges mailboxes with other racks.

    See `rack.boards.lan.adapter`.
    """

    rate_hz: Positive = Field(50.0, ge=1e-6)
    """rate of the board [Hz]; must divide the clock rate"""

    def build_board(self) -> BoardConfig:
        """Return this table as the table of a board, `[board.lan]`."""
        placement = {key: value for key, value in self if key not in LanTable.model_fields}
        params = self.model_dump(
            exclude_none=True, by_alias=True, include=set(LanTable.model_fields)
        )
        # Without its adapter, the rack cannot know which peers are present.
        on_loss: OnLoss = "stop" if self.on_peer_loss == "stop" else "hold"
        return BoardConfig(executor=LAN_ADAPTER, params=params, on_loss=on_loss, **placement)


class AdapterConfig(Table):
    """`[adapter]`: connections of the rack with the outside."""

    lan: LanConfig | None = None
    """exchange of mailboxes with other racks over a network"""


class HostConfig(Table):
    """`[host.<name>]`: host board, which has no slot, rate or priority.

    See `rack.levels.host_program`.
    """

    program: ClassName
    """class of the program, package.module:Class"""
    external: bool = False
    """the rack does not start the program; `rack prompt` runs it"""
    below: Neighbours = ()
    """bus adapter through which the program reaches the levels, or a list"""
    reads: dict[str, Sources] = {}
    """mailbox by port; overrides the sources that the program declares"""
    params: dict[str, Any] = {}
    """parameters of the program, declared by its class"""
    computing_ms: float = Field(0.0, ge=0.0, le=1e9)
    """simulated time of one computation in lockstep [ms]: from a wake-up until the messages of the
    program are passed on and it can be woken again; in real time it takes the actual time"""
    restarts: Restarts | None = None
    """overrides supervision.restarts for this board"""
    restarts_within_s: Positive | None = None
    """overrides supervision.within_s for this board [s]"""


class TaskEntry(NamedTuple):
    """Entry of the config for a task or a host board.

    Attributes:
        name: Name of the task, as in "servo" or "servo.planner".
        board: Name of its board.
        role: "executor", "planner", "standby" or "host".
        target: Its class, as "package.module:Class".
        slot: Its slot.
        core: The core that it requests.
        priority: Its SCHED_FIFO priority. 0 for ordinary scheduling.
    """

    name: str
    board: str
    role: Role
    target: str
    slot: int
    core: int
    priority: int

    @property
    def table(self) -> str:
        """Name of the task's table in the config, as in "board.servo" or "host.program"."""
        return f"{'host' if self.role == 'host' else 'board'}.{self.board}"

    @property
    def reads_key(self) -> str:
        """Key of the task's table that connects its inputs to mailboxes of the user's choice."""
        return "planner_reads" if self.role == "planner" else "reads"


class RackConfig(Table):
    """Config of a rack: everything that a run depends on."""

    format: int = Field(2, ge=1, le=2)
    """format of this config; 1, from before rack 0.2, is read like 2"""
    name: RackName
    """name of the rack and of its shared memory: at most 40 of a-z, 0-9, - and _"""
    seed: int = Field(0, ge=0, le=2**31 - 1)
    """seed of all random numbers"""
    python_path: tuple[Annotated[Path, Field(strict=False)], ...] = ()
    """folders with your own levels, added to the import path; relative to this file"""
    clock: ClockConfig
    """the system clock"""
    protocol: ProtocolConfig = ProtocolConfig()
    """protocols of the mailboxes"""
    timing: TimingConfig = TimingConfig()
    """assumptions of the timing model about the processors"""
    schedule: ScheduleConfig | None = None
    """static cyclic schedule of all boards"""
    robot: RobotConfig | None = None
    """the arm; required by levels that move one"""
    scene: SceneConfig = SceneConfig()
    """objects and obstacles around the arm"""
    task: dict[str, Any] = {}
    """program of the task level, declared by its class"""
    board: dict[str, BoardConfig] = Field(min_length=1)
    """boards by name; each runs the level of that name"""
    adapter: AdapterConfig = AdapterConfig()
    """connections with the outside: the network"""
    host: dict[str, HostConfig] = {}
    """host boards by name, which have no real-time guarantees"""
    supervision: SupervisionConfig = SupervisionConfig()
    """restarts of lost boards"""
    record: RecordConfig = RecordConfig()
    """how much of a run is recorded"""
    fault: tuple[FaultConfig, ...] = ()
    """faults injected into the run"""
    command: tuple[CommandConfig, ...] = ()
    """operator commands, each at a tick"""

    @model_validator(mode="after")
    def _add_adapter_boards(self) -> Self:
        """Add the board of the network adapter, if `[adapter.lan]` exists."""
        if self.adapter.lan is not None and LAN not in self.board:
            self.board[LAN] = self.adapter.lan.build_board()
        return self

    @property
    def is_lockstep(self) -> bool:
        """Whether the clock runs in lockstep instead of real time."""
        return self.clock.mode == "lockstep"

    @property
    def simulated_load(self) -> float:
        """Multiple of its budget that a cycle takes on a simulated core. 0 without such cores."""
        return self.timing.lockstep_load if self.is_lockstep else 0.0

    @property
    def takes_time(self) -> bool:
        """Whether computing takes time: in real time, and in lockstep on simulated cores."""
        return not self.is_lockstep or self.simulated_load > 0

    @property
    def clock_ns(self) -> int:
        """Length of a tick in ns of simulated time."""
        return round(self.clock.period_ms * 1e6)

    @property
    def tick_ns(self) -> int:
        """Length of a tick in ns of real time."""
        return round(self.clock_ns / self.clock.speed)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the arm's joints. Empty without an arm."""
        return () if self.robot is None else self.robot.joints

    def find_period(self, board: str) -> int:
        """Return the period of a board's executor in ticks.

        Raises:
            ClockError: The rate does not divide the clock rate.
        """
        config = self.board[board]
        if config.every is not None:
            return config.every
        return compute_period_ticks(config.rate_hz or 0.0, self.clock_ns, f"level '{board}'")

    def list_links(self) -> Iterator[tuple[str, str]]:
        """Yield each pair of neighbouring boards, as (upper, lower).

        Two boards are neighbours if at least one of them names the other in `above` or `below`.
        """
        listed = [(name, lower) for name, board in self.board.items() for lower in board.below]
        listed += [(upper, name) for name, board in self.board.items() for upper in board.above]
        yield from (
            link
            for link in dict.fromkeys(listed)
            if {*link} <= self.board.keys() and link[0] != link[1]
        )

    def find_boards_below(self, board: str) -> set[str]:
        """Return all boards below a board, directly or through other boards."""
        direct = {lower for upper, lower in self.list_links() if upper == board}
        return direct.union(*(self.find_boards_below(lower) for lower in direct))

    def list_tasks(self) -> Iterator[TaskEntry]:
        """Yield the tasks of all boards. The executor of a board comes before its planner."""
        for name, board in self.board.items():
            yield TaskEntry(
                name, name, "executor", board.executor, board.slot, board.core, board.priority
            )
            if board.planner is not None:
                slot = board.slot if board.planner_slot is None else board.planner_slot
                core = board.core if board.planner_core is None else board.planner_core
                yield TaskEntry(
                    f"{name}.planner",
                    name,
                    "planner",
                    board.planner,
                    slot,
                    core,
                    board.planner_priority,
                )

    def list_free_slots(self) -> list[int]:
        """Return the slots that no board has, in ascending order."""
        taken = {task.slot for task in self.list_tasks()}
        taken |= {standby.slot for _, standby in self.list_standby_tables()}
        return [slot for slot in range(CLOCK_SLOT + 1, LAST_SLOT + 1) if slot not in taken]

    def list_standby_tables(self) -> Iterator[tuple[str, StandbyConfig]]:
        """Yield the table of each standby with its place, as in "board.servo.standby[1]"."""
        if self.clock.standby is not None:
            yield "clock.standby", self.clock.standby
        for name, board in self.board.items():
            for number, standby in enumerate(board.standby):
                index = f"[{number}]" if len(board.standby) > 1 else ""
                yield f"board.{name}.standby{index}", standby

    def list_standbys(self) -> Iterator[TaskEntry]:
        """Yield the standbys of all boards, as in "servo.standby" and "servo.standby2"."""
        for name, board in self.board.items():
            for number, standby in enumerate(board.standby, start=1):
                yield TaskEntry(
                    f"{name}.standby{number if number > 1 else ''}",
                    name,
                    "standby",
                    board.executor,
                    standby.slot,
                    standby.core,
                    board.priority if standby.priority is None else standby.priority,
                )

    def list_hosts(self) -> Iterator[TaskEntry]:
        """Yield the host boards. They have no slot and run on any core."""
        for name, host in self.host.items():
            yield TaskEntry(name, name, "host", host.program, OUTSIDE, ANY_CORE, 0)

    def get_table(self, entry: TaskEntry | TaskSpec) -> BoardConfig | HostConfig:
        """Return the table of the board or host board to which a task belongs."""
        return self.host[entry.board] if entry.role == "host" else self.board[entry.board]

    def get_rewired_ports(self, place: TaskEntry) -> Mapping[str, Sources]:
        """Return the inputs of a task that the config rewires, with their new mailboxes."""
        sources: Mapping[str, Sources] = getattr(self.get_table(place), place.reads_key)
        return sources

    @property
    def outside_state(self) -> str:
        """Description of state outside the rack, which snapshots cannot contain. Empty if none.

        A rack with such state repeats a run only if it replays the messages that came from outside.
        """
        hosts = ", ".join(map(repr, self.host))
        states = [f"{hosts}: a host program's state"] if hosts else []
        states += [f"'{LAN}': what comes from the network"] if self.adapter.lan is not None else []
        return "; ".join(states)

    def to_toml_text(self) -> str:
        """Return the config as complete TOML text, which extends no other file."""
        # JSON mode cannot represent infinity and NaN, which parameters of levels may contain.
        tables = self.model_dump(exclude_none=True, by_alias=True)
        tables["python_path"] = [str(folder) for folder in self.python_path]
        if self.robot is not None:
            tables["robot"]["model"] = shorten_path(self.robot.model)
        if self.adapter.lan is not None:
            tables["board"].pop(LAN, None)
        tables = change_texts(tables, STATE_TABLES, lambda file: shorten_path(Path(file)))
        return to_toml(tables)
