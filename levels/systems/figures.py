"""The level of the paper's Gantt charts (section 3.4, figures 2 to 4): it only consumes processor
time.
"""

from __future__ import annotations

from time import process_time_ns
from typing import Annotated

from pydantic import Field as Parameter

from rack.backplane.message import Message, State, Status, field
from rack.backplane.process import compute_until
from rack.levels.level import Executor, Input, LevelContext, Output, Planner
from rack.levels.tables import Table, read_params


class FigurePlan(Message, version=1):
    """A plan of the level of the paper's Gantt charts."""

    made_at: int = field(unit="tick", doc="release that the plan answers")
    cycle: int = field(
        unit="tick", doc="cycle of the executor whose status the plan rests on; -1: none was there"
    )


class FigureStatus(Status, version=1):
    """Status of the level of the paper's Gantt charts."""

    cycle: int = field(unit="tick", doc="release of this cycle")
    plan: int = field(
        unit="tick", doc="release that the plan in force answers; -1: there is none yet"
    )


NS_PER_MS = 1e6
Milliseconds = Annotated[float, Parameter(ge=0, le=10_000, allow_inf_nan=False)]


class FigureParams(Table):
    """Processor times of the level's unit functions; R, W, U and C are the bus's, in
    `[board.<name>.transfer]`.
    """

    process_ms: Milliseconds | Annotated[tuple[Milliseconds, ...], Parameter(min_length=1)] = 2.0
    """X: the executor in a cycle [ms]; several times are taken in turn, cycle by cycle"""
    plan_ms: Milliseconds = 6.0
    """P: one plan, without its update [ms]"""


class FigureLoop(Executor):
    """Computes for X of processor time in every cycle: a level without a planner."""

    status = Output(FigureStatus)
    params = FigureParams
    plan_in_use = -1
    """Release that the plan in force answers; -1: there is none."""

    def __init__(self, context: LevelContext) -> None:
        """Raise `LevelError` for an invalid parameter."""
        super().__init__(context)
        times_ms = read_params(FigureParams, context.params).process_ms
        if not isinstance(times_ms, tuple):
            times_ms = (times_ms,)
        self._times_ns = [round(ms * NS_PER_MS) for ms in times_ms]

    def process(self, tick: int) -> None:
        """Report, then compute; time spent preempted does not count."""
        end = process_time_ns() + self._times_ns[tick // self.context.every % len(self._times_ns)]
        status = self.status
        status.state = State.EXECUTING
        status.cycle = tick
        status.plan = self.plan_in_use
        compute_until(end)


class FigureExecutor(FigureLoop):
    """Reports which plan is in force, too."""

    plan = Input(FigurePlan, "own.plan")

    def process(self, tick: int) -> None:
        """Report, with the plan in force, then compute."""
        if self.plan.is_there:
            self.plan_in_use = self.plan.message.made_at
        super().process(tick)


class FigurePlanner(Planner):
    """Computes for P of processor time, then begins the next plan: one is always wanted."""

    status = Input(FigureStatus, "own.status")
    output = Output(FigurePlan)
    params = FigureParams

    def __init__(self, context: LevelContext) -> None:
        """Raise `LevelError` for an invalid parameter."""
        super().__init__(context)
        self._time_ns = round(read_params(FigureParams, context.params).plan_ms * NS_PER_MS)

    def wanted(self, tick: int) -> bool:
        """Return True: a plan is always wanted."""
        return True

    def plan(self, tick: int) -> None:
        """Report, then compute; time spent preempted does not count."""
        end = process_time_ns() + self._time_ns
        self.output.made_at = tick
        self.output.cycle = self.status.message.cycle if self.status.is_there else -1
        compute_until(end)
