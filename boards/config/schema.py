"""The tables of a rack's config: every key with its unit, range and meaning.

`[robot]` and `[scene]` are declared in `rack.levels.robot` and `rack.levels.scene`; what `[task]`
and `[board.<name>.params]` may hold is declared by the classes of the levels. In a description the
unit stands in brackets; `rack schema` shows it in a separate column.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from rack.backplane.clock.system_clock import ticks_of
from rack.backplane.layout import Role, TaskSpec, Wake
from rack.backplane.rack_name import RACK_NAME
from rack.boards.config.files import LAN_ADAPTER, STATE_TABLES, portable, with_texts
from rack.boards.config.protocols import MailboxName, ProtocolConfig
from rack.boards.config.record import RecordConfig
from rack.boards.config.toml import to_toml
from rack.boards.faults.config import FaultConfig
from rack.boards.lan.config import LanTable
from rack.levels.operator import NAME_BYTES, Goal, Operation
from rack.levels.tables import (
    Finite,
    Moment,
    Positive,
    RobotConfig,
    SceneConfig,
    Table,
    Tick,
    Vector,
)

CLOCK_SLOT = 1
"""Slot of the system controller, as on VME."""
LAST_SLOT = 21
OUTSIDE = 0
"""Stands for the slot of a host board, which has none."""
ANY_CORE = -1

Coupling = Literal["tight", "loose", "none"]
Mode = Literal["realtime", "lockstep"]
OnLoss = Literal["hold", "stop", "brake"]


def _listed(value: Any) -> Any:
    """Return a single name as a list of one, and TOML's list as a tuple."""
    if isinstance(value, str):
        return (value,)
    return tuple(value) if isinstance(value, list) else value


RackName = Annotated[str, StringConstraints(pattern=f"^{RACK_NAME}$")]
ClassName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]
Neighbours = Annotated[tuple[str, ...], BeforeValidator(_listed)]
Sources = Annotated[tuple[MailboxName, ...], BeforeValidator(_listed)]
Slot = Annotated[int, Field(ge=CLOCK_SLOT + 1, le=LAST_SLOT)]
Core = Annotated[int, Field(ge=0, le=1023)]
Priority = Annotated[int, Field(ge=0, le=99)]
Restarts = Annotated[int, Field(ge=0, le=10_000)]
Milliseconds = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
SHORTEST_MS = 0.01
"""Shortest tick, in real time and in simulated time."""
FORMAT = 2
"""The newest format of configs: that of rack 0.2."""
CHANGED = (
    'config format 1, from before rack 0.2: since then clock.idle_cores is "sleep" unless it is'
    " given, and classes of levels have moved (old names still work); write format = 2 when that"
    " suits you"
)
RESTART_S = 2.0
"""Longest time of a restart in real time: a planner with its libraries takes 1.5 s."""
LONGEST_EVERY = 1_000_000
"""Longest cycle of a board, ticks."""


class ClockConfig(Table):
    """`[clock]`: the system clock and its board, the system controller in slot 1."""

    scheduler: Literal["fixed-priority", "earliest-deadline-first"] = "fixed-priority"
    """fixed-priority: SCHED_FIFO, by the boards' priority; earliest-deadline-first: in real time
    SCHED_DEADLINE, by their cycles, with twice their budgets reserved; on any core where the kernel
    refuses theirs"""
    on_no_realtime: Literal["refuse", "warn"] = "warn"
    """if a SCHED_FIFO priority is refused: warn and continue, or refuse to launch"""
    period_ms: float = Field(ge=SHORTEST_MS, le=1000, allow_inf_nan=False)
    """tick period [ms]; a whole number of ns"""
    mode: Mode = "realtime"
    """realtime: ticks follow wall-clock time; lockstep: each tick comes once every task is done"""
    speed: float = Field(1.0, ge=0.001, le=1000, allow_inf_nan=False)
    """simulated time divided by real time; 2 runs twice as fast"""
    wake: Wake = "timer"
    """how boards wait for their next cycle: timer: each sleeps to its own grid point; signal: until
    the clock wakes them; poll: busy-wait"""
    idle_cores: Literal["sleep", "awake"] = "sleep"
    """in real time, idle cores sleep or are held awake, which root alone may do; awake: wake-ups
    are earlier by some 20 us on bare metal; a virtual machine may lose its cores for ms; see rack
    bench machine"""
    core: Core = 0
    """core of the system controller"""
    priority: Priority = 0
    """SCHED_FIFO priority of the system controller; 0: ordinary scheduling"""


class TimingConfig(Table):
    """`[timing]`: assumptions of the timing model about the processors."""

    context_switch_ms: Milliseconds = 0.1
    """time of one context switch (t_cs) [ms]; the paper takes 0.1"""
    response_ms: float | None = Field(None, ge=SHORTEST_MS, le=1e9)
    """goal for the response time R_s of the system (eqs 3.2, 3.3) [ms]; simulated time; R_max is
    R_s / n"""
    clock_ms: Milliseconds = 0.0
    """processor time of the system clock's board per tick [ms]"""
    small_share: float = Field(0.1, gt=0, le=1)
    """largest fraction of a cycle that counts as much smaller than it (eq. 3.10)"""


class ScheduleConfig(Table):
    """`[schedule]`: a static cyclic schedule, in which every board has its place; see
    `rack.boards.timing.frames`.
    """

    minor_ms: Positive
    """minor frame [ms]; a whole number of ticks, of which every board's cycle is a multiple"""
    major_ms: Positive
    """major frame [ms]; a multiple of the minor one, which every board's cycle divides"""


class BudgetConfig(Table):
    """`[board.<name>.budget]`: the level's worst-case processor times, for the timing model."""

    read_ms: Milliseconds = 0.0
    """R: read commands and statuses, per cycle [ms]"""
    process_ms: Milliseconds = 0.0
    """X: process, per cycle [ms]"""
    write_ms: Milliseconds = 0.0
    """W: write commands and statuses, per cycle [ms]"""
    exchange_ms: Milliseconds = 0.0
    """C: read the plan, per cycle [ms]"""
    plan_ms: Milliseconds = 0.0
    """P: plan, per plan [ms]"""
    update_ms: Milliseconds = 0.0
    """U: write the plan, per plan [ms]"""
    plan_within_ms: float | None = Field(None, gt=0, le=1e7)
    """longest acceptable time for a new plan [ms]; an upper limit on within_cycles"""


class TransferConfig(Table):
    """`[board.<name>.transfer]`: minimum processor times of bus accesses, to emulate a slower
    bus.
    """

    read_ms: Milliseconds = 0.0
    """R: the executor reads commands and statuses, per cycle [ms]"""
    write_ms: Milliseconds = 0.0
    """W: the executor writes commands and statuses, per cycle [ms]"""
    exchange_ms: Milliseconds = 0.0
    """C: the executor reads the plan, per cycle [ms]"""
    update_ms: Milliseconds = 0.0
    """U: the planner writes its plan [ms]"""


class ExchangeConfig(Table):
    """`[board.<name>.exchange.<port>]`: when the executor reads one of its ports; default: in every
    cycle.
    """

    every: int = Field(1, ge=1, le=LONGEST_EVERY)
    """read in every n-th cycle; in between, the last message stays"""
    phase: int = Field(0, ge=0)
    """number, less than every, of the first cycle that reads it [cycles]"""
    asynchronous: bool = False
    """read the newest message as soon as it is written; in real time, runs then differ"""


class SupervisionConfig(Table):
    """`[supervision]`: restarts of boards that die or hang, and the cycles that a level may lose.
    When no restarts are left, the brakes stay engaged.
    """

    restarts: Restarts = 5
    """maximum number of restarts of one task within within_s; 0: never restart"""
    within_s: Positive = 10.0
    """time window in which restarts are counted [s]; simulated time"""
    lockstep_restart_s: Positive = 0.5
    """in lockstep, simulated time until a lost task returns [s]; in real time it returns when
    ready"""
    max_missed_fraction: float = Field(0.05, ge=0, le=1)
    """largest fraction of its cycles that a level may miss or skip in a run that succeeds, rounded
    up to whole cycles; those due while an injected fault acts, or during the recovery from it, are
    excused; 1: never judged"""

    def restart_s(self, lockstep: bool) -> float:
        """Return the longest simulated time that a restart may take."""
        return self.lockstep_restart_s if lockstep else max(RESTART_S, self.lockstep_restart_s)


class PlacedConfig(Table):
    """Keys of a board in the crate, whether a level or the network adapter runs on it."""

    slot: Slot
    """slot in the crate; slot 1 is the clock's"""
    core: Core = 0
    """core of the board; if the machine lacks it, another core is used"""
    priority: Priority = 0
    """SCHED_FIFO priority of the executor; 0: ordinary scheduling"""
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
    """instead of rate_hz: period of the executor [ticks]"""
    phase: int = Field(0, ge=0)
    """first tick of the board, less than its period; its releases follow every period [ticks]"""
    wake: Wake | None = None
    """how this board waits for its next cycle; default: clock.wake"""
    above: Neighbours = ()
    """board of the level above, whose commands this level reads; or a list"""
    below: Neighbours = ()
    """board of the level below, whose status this level reads; or a list"""
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
    """core of a loosely coupled planner; default: the board's"""
    planner_priority: Priority = 0
    """SCHED_FIFO priority of the planner; 0: ordinary scheduling"""
    reads: dict[str, Sources] = {}
    """mailbox by port of the executor, or a list; overrides the level's own"""
    planner_reads: dict[str, Sources] = {}
    """mailbox by port of the planner, likewise"""
    exchange: dict[str, ExchangeConfig] = {}
    """when the executor reads a port, by port; also records the ages of all its messages"""
    params: dict[str, Any] = {}
    """parameters of the level, declared by its class"""
    transfer: TransferConfig = TransferConfig()
    """emulation of a slower bus for this board"""
    ends_run: bool = False
    """end the run when this level's status is done or error"""
    on_loss: OnLoss = "hold"
    """while this board is lost: hold: the level below holds; stop: the arm ramps to rest, then
    brakes; brake: the arm brakes at once"""

    @property
    def busy_ms(self) -> float:
        """Processor time of a cycle of the executor by its budget, ms; 0: it has none."""
        own = self.budget
        return 0.0 if own is None else own.exchange_ms + own.read_ms + own.process_ms + own.write_ms


LAN = "lan"
"""Name of the board that exchanges mailboxes with other racks."""


class LanConfig(PlacedConfig, LanTable):
    """`[adapter.lan]`: the board that exchanges mailboxes with other racks: see
    `rack.boards.lan.adapter`.
    """

    rate_hz: Positive = Field(50.0, ge=1e-6)
    """rate of the board [Hz]; must divide the clock rate"""

    def board(self) -> BoardConfig:
        """Return the board."""
        own = {key: value for key, value in self if key not in LanTable.model_fields}
        params = self.model_dump(
            exclude_none=True, by_alias=True, include=set(LanTable.model_fields)
        )
        # Without its adapter a rack does not know which others are there.
        on_loss: OnLoss = "stop" if self.on_peer_loss == "stop" else "hold"
        return BoardConfig(executor=LAN_ADAPTER, params=params, on_loss=on_loss, **own)


class AdapterConfig(Table):
    """`[adapter]`: ways out of the rack."""

    lan: LanConfig | None = None
    """exchange of mailboxes with other racks over a network"""


class HostConfig(Table):
    """`[host.<name>]`: one board of the host side, without slot, rate and priority: see
    `rack.levels.host_program`.
    """

    program: ClassName
    """class of the program, package.module:Class"""
    external: bool = False
    """the rack does not start it: it is run by 'rack prompt'"""
    below: Neighbours = ()
    """bus adapter through which it reaches the levels; or a list"""
    reads: dict[str, Sources] = {}
    """mailbox by port; overrides the program's own"""
    params: dict[str, Any] = {}
    """parameters of the program, declared by its class"""
    computing_ms: float = Field(0.0, ge=0.0, le=1e9)
    """in lockstep, simulated time from a wake-up until what it sends is passed on and it may be
    woken again [ms]; in real time its computing takes as long as it takes"""
    restarts: Restarts | None = None
    """overrides supervision.restarts for this board"""
    restarts_within_s: Positive | None = None
    """overrides supervision.within_s for this board [s]"""


class CommandConfig(Table):
    """`[[command]]`: one operator command to one level."""

    level: str
    """board whose level is commanded, as in servo or task"""
    what: Literal[
        "hold",
        "resume",
        "setpoint",
        "goto",
        "modify",
        "table",
        "do",
        "set",
        "enable",
        "disable",
        "reset",
        "release",
    ]
    """hold: come to rest; resume: continue; setpoint, goto: move to a goal and stay there; modify:
    put a control modification in or take it out; table: decide by another state table; do: do one
    of the level's own commands; set: set a live parameter of the level; enable, disable: give
    torque to the arm, or take it; reset: clear a fault of its drives; release: end
    robot.bring_up"""
    tick: Tick | None = None
    """tick at which the command is issued; give at most one of tick, at"""
    at: Moment | None = None
    """instead of tick: simulated time [s]"""
    joints: tuple[Finite, ...] | None = None
    """goal: one position per joint [rad]"""
    position: Vector | None = None
    """goal: tool position [m]; with quaternion or direction"""
    quaternion: tuple[Finite, Finite, Finite, Finite] | None = None
    """goal: tool orientation as w, x, y, z"""
    direction: Vector | None = None
    """goal: direction of the tool's z axis, rotation about it left free; default: down"""
    home: bool = False
    """goal: the arm's start position"""
    name: Annotated[str, StringConstraints(max_length=NAME_BYTES)] | None = None
    """control modification to put in or take out; name of a table; command to do, as in pick
    block1; parameter to set, as in bandwidth=80"""
    on: bool | None = None
    """true: put it in; false: take it out"""

    @property
    def said(self) -> Operation:
        """The operation commanded."""
        return Operation[self.what.upper()]

    @property
    def goals(self) -> list[Goal]:
        """The goals given; valid are one or none, depending on the operation."""
        found = [Goal.JOINTS] if self.joints is not None else []
        if self.position is not None or self.quaternion is not None or self.direction is not None:
            found.append(Goal.DIRECTION if self.quaternion is None else Goal.POSE)
        found += [Goal.HOME] if self.home else []
        return found if self.on is None else [*found, Goal.ON if self.on else Goal.OFF]


class TaskPlace(NamedTuple):
    """A task's place in the config: class, slot, requested core and SCHED_FIFO priority; that of a
    host board.
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
        """Its table, as in "board.servo"."""
        return f"{'host' if self.role == 'host' else 'board'}.{self.board}"

    @property
    def class_key(self) -> str:
        """The key of its class."""
        return "program" if self.role == "host" else self.role

    @property
    def reads_key(self) -> str:
        """The key under which its ports are rewired."""
        return "planner_reads" if self.role == "planner" else "reads"


class RackConfig(Table):
    """A rack: everything that a run depends on."""

    format: int = Field(1, ge=1, le=FORMAT)
    """2: as described here; 1, without this key: from before rack 0.2, whose changes a launch
    tells"""
    name: RackName
    """name of the rack and of its shared memory: a-z, 0-9, - and _, at most 40"""
    seed: int = Field(0, ge=0, le=2**31 - 1)
    """seed of all random numbers"""
    python_path: tuple[Annotated[Path, Field(strict=False)], ...] = ()
    """folders with your own levels, added to the import path; relative to this file"""
    clock: ClockConfig
    """the system clock"""
    protocol: ProtocolConfig = ProtocolConfig()
    """how mailboxes are shared"""
    timing: TimingConfig = TimingConfig()
    """assumptions of the timing model about the processors"""
    schedule: ScheduleConfig | None = None
    """static cyclic schedule of all boards, if they have one"""
    robot: RobotConfig | None = None
    """the arm; required by levels that move one"""
    scene: SceneConfig = SceneConfig()
    """the cell around the arm"""
    task: dict[str, Any] = {}
    """program of the task level, declared by its class"""
    board: dict[str, BoardConfig] = Field(min_length=1)
    """boards by name; each runs the level of that name"""
    adapter: AdapterConfig = AdapterConfig()
    """ways out of the rack: the network"""
    host: dict[str, HostConfig] = {}
    """boards of the host side by name, without real time"""
    supervision: SupervisionConfig = SupervisionConfig()
    """restarts of lost boards"""
    record: RecordConfig = RecordConfig()
    """what is kept of a run"""
    fault: tuple[FaultConfig, ...] = ()
    """faults injected into the run"""
    command: tuple[CommandConfig, ...] = ()
    """operator commands, each at a tick"""

    @model_validator(mode="after")
    def _with_adapters(self) -> Self:
        """Add the adapter's board to the others."""
        if self.adapter.lan is not None and LAN not in self.board:
            self.board[LAN] = self.adapter.lan.board()
        return self

    @property
    def changed(self) -> list[str]:
        """What has changed since the format of this config: a line, if it is not the newest."""
        return [CHANGED] if self.format < FORMAT else []

    @property
    def is_lockstep(self) -> bool:
        """Whether each tick comes once every task is done, instead of by wall-clock time."""
        return self.clock.mode == "lockstep"

    @property
    def clock_ns(self) -> int:
        """One tick, in ns of simulated time."""
        return round(self.clock.period_ms * 1e6)

    @property
    def tick_ns(self) -> int:
        """One tick, in ns of the wall clock."""
        return round(self.clock_ns / self.clock.speed)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the arm's joints; none in a rack without an arm."""
        return () if self.robot is None else self.robot.joints

    def every(self, board: str) -> int:
        """Return the period of a board's executor, ticks. Raises `ClockError` if it is off the
        grid.
        """
        config = self.board[board]
        if config.every is not None:
            return config.every
        return ticks_of(config.rate_hz or 0.0, self.clock_ns, f"level '{board}'")

    def links(self) -> Iterator[tuple[str, str]]:
        """Yield board above and board below of every two neighbours, whichever of them names the
        other.
        """
        listed = [(name, lower) for name, board in self.board.items() for lower in board.below]
        listed += [(upper, name) for name, board in self.board.items() for upper in board.above]
        yield from (
            link
            for link in dict.fromkeys(listed)
            if {*link} <= self.board.keys() and link[0] != link[1]
        )

    def all_below(self, board: str) -> set[str]:
        """Return the boards below a board, directly or not."""
        direct = {lower for upper, lower in self.links() if upper == board}
        return direct.union(*(self.all_below(lower) for lower in direct))

    def tasks(self) -> Iterator[TaskPlace]:
        """Yield every task in order: each board's executor, then its planner."""
        for name, board in self.board.items():
            yield TaskPlace(
                name, name, "executor", board.executor, board.slot, board.core, board.priority
            )
            if board.planner is not None:
                slot = board.slot if board.planner_slot is None else board.planner_slot
                core = board.core if board.planner_core is None else board.planner_core
                yield TaskPlace(
                    f"{name}.planner",
                    name,
                    "planner",
                    board.planner,
                    slot,
                    core,
                    board.planner_priority,
                )

    def hosts(self) -> Iterator[TaskPlace]:
        """Yield every board of the host side, outside the crate: it has no slot, and runs on any
        core.
        """
        for name, host in self.host.items():
            yield TaskPlace(name, name, "host", host.program, OUTSIDE, ANY_CORE, 0)

    def table(self, of: TaskPlace | TaskSpec) -> BoardConfig | HostConfig:
        """Return the table of a task's board, or of a host board."""
        return self.host[of.board] if of.role == "host" else self.board[of.board]

    def rewired(self, place: TaskPlace) -> Mapping[str, Sources]:
        """Return the mailboxes that the config gives to ports of a task or host board, by port."""
        found: Mapping[str, Sources] = getattr(self.table(place), place.reads_key)
        return found

    @property
    def outside(self) -> str:
        """Whose state is not the rack's, so that it has no snapshots; empty: nobody's.

        Such a rack repeats itself only with what came from outside of it then.
        """
        hosts = ", ".join(map(repr, self.host))
        found = [f"{hosts}: a host program's state"] if hosts else []
        found += [f"'{LAN}': what comes from the network"] if self.adapter.lan is not None else []
        return "; ".join(found)

    def text(self) -> str:
        """Return the config as self-contained TOML that loads to the same config."""
        # Not in JSON mode, which lacks infinity and NaN: parameters of levels may use them.
        tables = self.model_dump(exclude_none=True, by_alias=True)
        tables["python_path"] = [str(folder) for folder in self.python_path]
        if self.robot is not None:
            tables["robot"]["model"] = portable(self.robot.model)
        if self.adapter.lan is not None:
            tables["board"].pop(LAN, None)
        tables = with_texts(tables, STATE_TABLES, lambda file: portable(Path(file)))
        return to_toml(tables)
