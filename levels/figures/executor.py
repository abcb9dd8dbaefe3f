"""The executor of figures 2 to 4."""

from __future__ import annotations

from time import process_time_ns

from rack.backplane.message import State
from rack.backplane.process import compute_until
from rack.levels.figures.messages import FIGURE_PLAN, FIGURE_STATUS
from rack.levels.figures.params import FigureParams
from rack.levels.level import Executor, Input, LevelContext, Ports
from rack.levels.params import read_params


class FigureExecutor(Executor):
    """Computes for X of processor time in every cycle, and tells which plan it has."""

    inputs = {"plan": Input(FIGURE_PLAN, "own.plan")}
    outputs = {"status": FIGURE_STATUS}
    params = FigureParams

    def __init__(self, context: LevelContext) -> None:
        """Raise `LevelError` for a parameter that is not one."""
        super().__init__(context)
        self._times_ns = read_params(FigureParams, context.params).process_ns

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Tell, and compute; time in which the process has no processor does not count."""
        end = process_time_ns() + self._times_ns[tick // self.context.every % len(self._times_ns)]
        status, plan = write.status, read.plan
        status.state = State.EXECUTING
        status.cycle = tick
        status.plan = plan.value.made_at if plan.is_there else -1
        compute_until(end)
