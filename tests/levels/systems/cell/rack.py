"""A coordinator and one arm, all levels and the simulated PUMA, as boards of one rack in one
process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rack.backplane.message import Message
from rack.boards.config import load
from rack.levels.systems.cell import Coordinator, OrderedTaskExecutor, OrderedTaskPlanner
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.whole_rack import board

TASK_EVERY = 100


ORDERED = BoardSpec(
    "task",
    TASK_EVERY,
    OrderedTaskExecutor,
    OrderedTaskPlanner,
    4,
    below="elemental_move",
    params={"orders": "cell.order_puma"},
)
"""The arm's task level."""


class CellRack(Lockstep):
    """The coordinator `cell` and the PUMA."""

    def __init__(self, *steps: Sequence[Mapping[str, Any]], **params: Any) -> None:
        cell = BoardSpec(
            "cell", TASK_EVERY, Coordinator, params={"arms": {"puma": "task.report"}, **params}
        )
        nasrem = load("nasrem")
        below = [board(nasrem, name, {}) for name in nasrem.board if name != "task"]
        task = {"step": [{"do": [{"arm": "puma", **action} for action in step]} for step in steps]}
        super().__init__([*below, ORDERED, cell], *config("puma560"), task)

    @property
    def cell(self) -> Message:
        """The coordinator's status."""
        return self.read("cell.status")

    @property
    def task(self) -> Message:
        """The arm's status."""
        return self.read("task.status")

    @property
    def report(self) -> Message:
        """What the arm reports to the coordinator."""
        return self.read("task.report")
