"""The tables of a rack's config: every field with its unit, range and meaning.

`[robot]` and `[scene]` are of `rack.levels.robot` and `rack.levels.scene`; `[task]` is the task level's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from rack.backplane.clock.system_clock import ticks_of
from rack.backplane.layout import Protocol
from rack.boards.config.text import portable, to_toml
from rack.boards.faults.config import FaultConfig
from rack.boards.operating.config import CommandConfig
from rack.levels.robot import Positive, RobotConfig, Table
from rack.levels.scene import SceneConfig

CLOCK_SLOT = 1
"""Slot of the system controller, as on VME."""
LAST_SLOT = 21

Coupling = Literal["tight", "loose", "none"]
Mode = Literal["realtime", "lockstep"]
Wake = Literal["signal", "poll"]
OnNoRealtime = Literal["refuse", "warn"]
OnLoss = Literal["hold", "stop", "brake"]

RackName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
ClassName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]
MailboxName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
Slot = Annotated[int, Field(gt=CLOCK_SLOT, le=LAST_SLOT)]
Core = Annotated[int, Field(ge=0, le=1023)]
Priority = Annotated[int, Field(ge=0, le=99)]
Restarts = Annotated[int, Field(ge=0, le=10_000)]
Milliseconds = Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)]
SHORTEST_MS = 0.01
"""One tick, in real time and in simulated time, at least."""
LONGEST_EVERY = 1_000_000
"""Ticks from one cycle of a board to the next, at most."""


class ClockConfig(Table):
    """`[clock]`: the system clock and its board, the system controller in slot 1."""

    period_ms: float = Field(ge=SHORTEST_MS, le=1000, allow_inf_nan=False, description="one tick, ms, in whole ns")
    mode: Mode = Field("realtime", description="ticks by time, or lockstep: as soon as every task has finished")
    speed: float = Field(
        1.0,
        ge=0.001,
        le=1000,
        allow_inf_nan=False,
        description="real time runs this many times faster than simulated time",
    )
    wake: Wake = Field("signal", description="how boards wait for their cycle: a semaphore each, or busy-waiting")
    core: Core = Field(0, description="core of the system controller")
    priority: Priority = Field(0, description="SCHED_FIFO priority of the system controller; 0: ordinary scheduling")
    on_no_realtime: OnNoRealtime = Field(
        "warn", description="where a SCHED_FIFO priority is not obtained: go on with a warning, or refuse the launch"
    )


class TimingConfig(Table):
    """`[timing]`: what the timing model is told of the processors."""

    context_switch_ms: Milliseconds = Field(0.1, description="one switch between tasks, t_cs, ms; 0.1 is the paper's")
    response_ms: float | None = Field(
        None,
        ge=SHORTEST_MS,
        le=1e9,
        description="goal: the system responds within R_s (eqs 3.2, 3.3), simulated ms; R_max is then R_s / n",
    )
    clock_ms: Milliseconds = Field(0.0, description="processor time of the system clock's board in one tick, ms")
    small_share: float = Field(
        0.1, gt=0, le=1, description="part of a cycle that counts as much smaller than it (eq. 3.10)"
    )


class BudgetConfig(Table):
    """`[board.<name>.budget]`: what the level may take in the worst case, as processor time in ms."""

    read_ms: Milliseconds = Field(0.0, description="R: reading commands and statuses, a cycle")
    process_ms: Milliseconds = Field(0.0, description="X: the executor's processing, a cycle")
    write_ms: Milliseconds = Field(0.0, description="W: writing commands and statuses, a cycle")
    exchange_ms: Milliseconds = Field(0.0, description="C: reading the plan, a cycle")
    plan_ms: Milliseconds = Field(0.0, description="P: the planner, a plan")
    update_ms: Milliseconds = Field(0.0, description="U: writing the plan, a plan")
    plan_within_ms: float | None = Field(
        None, gt=0, le=1e7, description="a new plan is wanted within this time, ms: what within_cycles may come to"
    )


class TransferConfig(Table):
    """`[board.<name>.transfer]`: a slower bus: processor time that accesses are made to take, ms."""

    read_ms: Milliseconds = Field(0.0, description="R: the executor reads commands and statuses, a cycle")
    write_ms: Milliseconds = Field(0.0, description="W: it writes commands and statuses, a cycle")
    exchange_ms: Milliseconds = Field(0.0, description="C: it reads the plan, a cycle")
    update_ms: Milliseconds = Field(0.0, description="U: the planner writes its plan")


class ProtocolConfig(Table):
    """`[protocol]`: how mailboxes are shared."""

    default: Protocol = Field("time-slice", description="protocol of every mailbox not named below")
    mailbox: dict[MailboxName, Protocol] = Field({}, description="protocol by mailbox")


class SupervisionConfig(Table):
    """`[supervision]`: boards that die or hang are restarted. When restarts are used up, the arm is braked for good."""

    restarts: Restarts = Field(5, description="restarts of one task within within_s, at most; 0: never")
    within_s: Positive = Field(10.0, description="time over which restarts are counted, simulated s")
    lockstep_restart_s: Positive = Field(
        0.5,
        description="in lockstep, simulated time from a task's loss to its return, s; real time takes its own",
    )


class BoardConfig(Table):
    """`[board.<name>]`: one processor of the rack, its level, and how that is wired."""

    slot: Slot = Field(description="slot in the crate, 2 to 21; slot 1 is the clock's")
    core: Core = Field(0, description="core that the board is pinned to; cores the machine lacks are shared out")
    rate_hz: Positive | None = Field(None, ge=1e-6, description="rate of the executor, Hz; must divide the clock's")
    every: int | None = Field(
        None, ge=1, le=LONGEST_EVERY, description="instead of rate_hz: period of the executor, ticks"
    )
    priority: Priority = Field(0, description="SCHED_FIFO priority of the executor; 0: ordinary scheduling")
    wake: Wake | None = Field(None, description="how this board waits for its cycle; default: clock.wake")
    above: str | None = Field(None, description="board of the level above, whose commands are read")
    below: str | None = Field(None, description="board of the level below, whose status is read")
    executor: ClassName = Field(description="class of the executor, package.module:Class")
    planner: ClassName | None = Field(None, description="class of the planner, package.module:Class")
    coupling: Coupling = Field("none", description="planner on this board (tight), on its own (loose), or none")
    within_cycles: int = Field(1, ge=1, le=10_000, description="cycles that one plan may take")
    planner_slot: Slot | None = Field(None, description="slot of a loosely coupled planner, 2 to 21")
    planner_core: Core | None = Field(None, description="core of a loosely coupled planner")
    planner_priority: Priority = Field(0, description="SCHED_FIFO priority of the planner; 0: ordinary scheduling")
    reads: dict[str, MailboxName] = Field({}, description="mailbox by port of the executor, where not the level's own")
    planner_reads: dict[str, MailboxName] = Field({}, description="the same for the planner")
    params: dict[str, Any] = Field({}, description="parameters of the level, by name")
    budget: BudgetConfig | None = Field(None, description="what the level may take, for the timing model")
    transfer: TransferConfig = Field(TransferConfig(), description="a slower bus for this board")
    ends_run: bool = Field(False, description="the run ends when this level's status says done or error")
    restarts: Restarts | None = Field(None, description="as in supervision, for this board's tasks; 0: never")
    restarts_within_s: Positive | None = Field(None, description="as supervision.within_s, for this board's tasks, s")
    on_loss: OnLoss = Field(
        "hold",
        description="while this board is lost: the level below holds, or the arm ramps to rest and brakes, or brakes",
    )


class RackConfig(Table):
    """A rack, resolved: everything that a run depends on."""

    name: RackName = Field(description="name of the rack and of its shared memory: a-z, 0-9, - and _, at most 40")
    seed: int = Field(0, ge=0, le=2**31 - 1, description="seed of everything random")
    python_path: tuple[Annotated[Path, Field(strict=False)], ...] = Field(
        (), description="folders of your own levels, for import; relative to the file"
    )
    clock: ClockConfig = Field(description="the system clock")
    protocol: ProtocolConfig = Field(ProtocolConfig(), description="how mailboxes are shared")
    timing: TimingConfig = Field(TimingConfig(), description="what the timing model is told of the processors")
    robot: RobotConfig | None = Field(None, description="the arm; a rack without one has levels that need none")
    scene: SceneConfig = Field(SceneConfig(), description="what stands in the cell besides the arm")
    task: dict[str, Any] = Field({}, description="program of the task level")
    board: dict[str, BoardConfig] = Field(min_length=1, description="boards by name; each runs the level of that name")
    supervision: SupervisionConfig = Field(SupervisionConfig(), description="restarts of boards")
    fault: tuple[FaultConfig, ...] = Field((), description="faults injected into the run")
    command: tuple[CommandConfig, ...] = Field((), description="commands of an operator, given at their ticks")

    @property
    def clock_ns(self) -> int:
        """One tick, in ns of simulated time."""
        return round(self.clock.period_ms * 1e6)

    def every(self, board: str) -> int:
        """Return the period of a board's executor, in ticks. Raises `ClockError` when off the grid."""
        config = self.board[board]
        if config.every is not None:
            return config.every
        return ticks_of(config.rate_hz or 0.0, self.clock_ns, f"level '{board}'")

    def text(self) -> str:
        """Return the config as TOML that loads again with the same meaning, by itself."""
        tables = self.model_dump(mode="json", exclude_none=True, by_alias=True)
        if self.robot is not None:
            tables["robot"]["model"] = portable(self.robot.model)
        return to_toml(tables)
