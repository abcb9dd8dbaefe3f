"""The planner of an ordered task level: one order as elemental moves, or the reason why it cannot
be done."""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.message import Message
from rack.levels.errors import Refused
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.systems.cell.actions import read_action
from rack.levels.systems.cell.messages import CELL_REQUEST
from rack.levels.systems.cell.params import OrderedTaskParams
from rack.levels.task.planner import TaskPlanner
from rack.levels.task.program import TaskConfig
from rack.levels.task.rehearsal import Rehearsed, finish_times


class OrderedTaskPlanner(TaskPlanner):
    """Plans what its executor requests: the action of an order, to begin later or at once."""

    inputs = {**TaskPlanner.inputs, "request": Input(CELL_REQUEST, "own.request")}
    params = OrderedTaskParams
    program = None

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._id = 0
        self._begin_s = 0.0  # simulated time at which the plan may have to begin

    def _first_program(self) -> TaskConfig:
        return TaskConfig()

    def wanted(self, read: Ports, tick: int) -> bool:
        """Return whether a request is not answered yet, and the world is known and at rest."""
        request: Message = read.request.value
        if request.id not in (0, self._id):
            # Whoever requests it has found that it suits the arm.
            action = read_action(request, self.context.robot, self.context.scene)
            self._program = TaskConfig(action=(action,))
            self._id = request.id
            self._plan = None
            self._begin_s = request.begin
            self._ahead_s = request.ahead
        return super().wanted(read, tick)

    def _reason(self, refused: Refused) -> str:
        """Return why the order is refused; it is one action, without a number."""
        return str(refused)

    def _visible_s(self, tick: int) -> float:
        return max(super()._visible_s(tick), self._begin_s + self.context.period_s)

    def _promise(self, moves: Sequence[Rehearsed], visible_s: float, write: Message) -> None:
        super()._promise(moves, visible_s, write)
        unhurried = [Rehearsed(move._replace(by_s=0.0), duration_s) for move, duration_s in moves]
        write.earliest = (
            finish_times(unhurried, visible_s, self._periods, self._needs)[-1] + self._ahead_s
        )
