"""A level without an arm whose executor is a state table: a counter."""

from __future__ import annotations

from rack.backplane.message import field
from rack.levels.level import Input, Inputs, Output
from rack.levels.operator import OperatorCommand
from rack.levels.systems.state_table.level import (
    StateTableExecutor,
    TableCommand,
    TableStatus,
    build_vocabulary,
)


class CounterStatus(TableStatus, version=1):
    """Counter status."""

    count: int = field(unit="1", doc="where the counter is")


class Counter(StateTableExecutor):
    """Counts up and down between 0 and 10, as its table says."""

    above = Inputs(TableCommand, "above.command", optional=True)
    last_status = Input(CounterStatus, "own.status")
    operator = Input(OperatorCommand, "own.operator")
    status = Output(CounterStatus)
    vocabulary = build_vocabulary(
        conditions={"count": ("low", "between", "high")},
        commands={"reset": (("low", "high"),)},
        actions={
            "count": (("up", "down"),),
            "set": (),
        },
    )
    count = 0

    def restore_state(self) -> None:
        super().restore_state()
        self.count = self.last_status.message.count

    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        return {"count": "low" if self.count <= 0 else "high" if self.count >= 10 else "between"}

    def do_count(self, way: str) -> None:
        """Count one."""
        self.count += 1 if way == "up" else -1

    def do_set(self) -> None:
        """Go to an end."""
        self.count = 0 if self.words[1] == "low" else 10

    def write_outputs(self, tick: int) -> None:
        self.status.count = self.count
