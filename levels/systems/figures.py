"""The level of the paper's Gantt charts, which only consumes processor time.

See section 3.4, figures 2 to 4.
"""

from __future__ import annotations

from time import process_time_ns
from typing import Annotated

from pydantic import Field as Parameter

from rack.backplane.message import Message, State, Status, field
from rack.backplane.process import busy_wait_until
from rack.levels.level import Executor, Input, LevelContext, Output, Planner
from rack.levels.tables import Table


class FigurePlan(Message, version=1):
    """A plan of the level of the paper's Gantt charts."""

    made_at: int = field(unit="tick", doc="release that the plan answers")
    cycle: int = field(
        unit="tick", doc="cycle of the executor whose status the plan is based on (-1: none)"
    )


class FigureStatus(Status, version=1):
    """Status of the level of the paper's Gantt charts."""

    cycle: int = field(unit="tick", doc="release of this cycle")
    plan: int = field(unit="tick", doc="release that the current plan answers (-1: no plan yet)")


NS_PER_MS = 1e6
Milliseconds = Annotated[float, Parameter(ge=0, le=10_000, allow_inf_nan=False)]


class FigureParams(Table):
    """Processor times of the level's unit functions, in `[board.<name>.params]`.

    The times R, W, U and C belong to the bus and are set in `[board.<name>.transfer]`.
    """

    process_ms: Milliseconds | Annotated[tuple[Milliseconds, ...], Parameter(min_length=1)] = 2.0
    """X: time of the executor in a cycle [ms]; a list is repeated, one entry per cycle"""
    plan_ms: Milliseconds = 6.0
    """P: one plan, without its update [ms]"""


class FigureLoop(Executor):
    """Level without a planner that consumes the processor time X in every cycle."""

    status = Output(FigureStatus)
    params = FigureParams
    settings: FigureParams
    plan_in_use = -1
    """Release for which the plan in use was computed; -1 before the first plan."""

    def __init__(self, context: LevelContext) -> None:
        """Read the parameters. Raises `LevelError` if one of them is invalid."""
        super().__init__(context)
        times_ms = self.settings.process_ms
        if not isinstance(times_ms, tuple):
            times_ms = (times_ms,)
        self._times_ns = [round(ms * NS_PER_MS) for ms in times_ms]

    def process(self, tick: int) -> None:
        """Write the status, then consume X. Time spent preempted does not count."""
        end = process_time_ns() + self._times_ns[tick // self.context.every % len(self._times_ns)]
        status = self.status
        status.state = State.EXECUTING
        status.cycle = tick
        status.plan = self.plan_in_use
        busy_wait_until(end)


class FigureExecutor(FigureLoop):
    """Executor that consumes the processor time X in every cycle and reports the plan in use."""

    plan = Input(FigurePlan, "own.plan")

    def process(self, tick: int) -> None:
        """Record the newest plan, then write the status and consume X."""
        if self.plan.has_message:
            self.plan_in_use = self.plan.message.made_at
        super().process(tick)


class FigurePlanner(Planner):
    """Planner that consumes the processor time P per plan and plans without a pause."""

    status = Input(FigureStatus, "own.status")
    output = Output(FigurePlan)
    params = FigureParams
    settings: FigureParams

    def __init__(self, context: LevelContext) -> None:
        """Read the parameters. Raises `LevelError` if one of them is invalid."""
        super().__init__(context)
        self._time_ns = round(self.settings.plan_ms * NS_PER_MS)

    def wanted(self, tick: int) -> bool:
        """Return True, so that the next plan begins as soon as the last one is finished."""
        return True

    def plan(self, tick: int) -> None:
        """Write the plan, then consume P. Time spent preempted does not count."""
        end_ns = process_time_ns() + self._time_ns
        self.output.made_at = tick
        self.output.cycle = self.status.message.cycle if self.status.has_message else -1
        busy_wait_until(end_ns)
