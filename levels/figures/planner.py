"""The planner of figures 2 to 4."""

from __future__ import annotations

from time import process_time_ns

from rack.backplane.message import Message
from rack.backplane.process import compute_until
from rack.levels.figures.messages import FIGURE_PLAN, FIGURE_STATUS
from rack.levels.figures.params import FigureParams
from rack.levels.level import Input, LevelContext, Planner, Ports
from rack.levels.params import read_params


class FigurePlanner(Planner):
    """Computes for P of processor time, then begins the next plan: one is always wanted."""

    inputs = {"status": Input(FIGURE_STATUS, "own.status")}
    output = FIGURE_PLAN
    params = FigureParams

    def __init__(self, context: LevelContext) -> None:
        """Raise `LevelError` for a parameter that is not one."""
        super().__init__(context)
        self._time_ns = read_params(FigureParams, context.params).plan_ns

    def wanted(self, read: Ports, tick: int) -> bool:
        """Want a plan, always."""
        return True

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Tell, and compute; time in which the executor has the processor does not count."""
        end = process_time_ns() + self._time_ns
        write.made_at = tick
        write.cycle = read.status.value.cycle if read.status.is_there else -1
        compute_until(end)
