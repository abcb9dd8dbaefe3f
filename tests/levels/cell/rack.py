"""A coordinator and one arm, all levels and the simulated PUMA, as boards of one rack in one process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rack.backplane.message import Message
from rack.boards.config import load
from rack.levels.cell import CELL_ORDER, Coordinator, OrderedTaskExecutor, OrderedTaskPlanner
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep
from tests.levels.whole_rack import board

TASK_EVERY = 100


def ordered(orders: str, params: Mapping[str, Any] | None = None) -> BoardSpec:
    """Return the board of an ordered task level that reads the mailbox `orders`."""
    return BoardSpec(
        "task",
        TASK_EVERY,
        OrderedTaskExecutor,
        OrderedTaskPlanner,
        4,
        below="elemental_move",
        params={"orders": orders, **(params or {})},
    )


def below(params: Mapping[str, Mapping[str, Any]] | None = None) -> list[BoardSpec]:
    """Return the boards below a task level."""
    nasrem = load("nasrem")
    return [board(nasrem, name, (params or {}).get(name, {})) for name in nasrem.board if name != "task"]


class CellRack(Lockstep):
    """The coordinator `cell` and the PUMA."""

    def __init__(self, *steps: Sequence[Mapping[str, Any]], **params: Any) -> None:
        cell = BoardSpec("cell", TASK_EVERY, Coordinator, params={"arms": {"puma": "task.report"}, **params})
        task = {"step": [{"do": [{"arm": "puma", **action} for action in step]} for step in steps]}
        super().__init__([*below(), ordered("cell.order_puma"), cell], *config("puma560"), task)

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


class OrderedArm(Lockstep):
    """The PUMA with an ordered task level; the test gives its orders."""

    def __init__(self, **params: Any) -> None:
        self.kinds = {"orders.puma": CELL_ORDER}
        super().__init__([*below(), ordered("orders.puma", params)], *config("puma560"), outside=self.kinds)
