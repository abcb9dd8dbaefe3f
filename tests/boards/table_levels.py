"""A level without an arm whose executor is a state table: a counter."""

from __future__ import annotations

from rack.backplane.message import Field, status
from rack.levels.level import Input, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.systems.state_table.level import (
    STATUS_HEAD,
    WORD_COMMAND,
    StateTableExecutor,
    vocabulary,
)

COUNTER_STATUS = status(
    "counter_status", 1, *STATUS_HEAD, Field("count", "i8", "1", "where the counter is")
)


class Counter(StateTableExecutor):
    """Counts up and down between 0 and 10, as its table says."""

    inputs = {
        "command": Input(WORD_COMMAND, "above.command", many=True, optional=True),
        "last_status": Input(COUNTER_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"status": COUNTER_STATUS}
    vocabulary = vocabulary(
        conditions={"count": ("low", "between", "high")},
        commands={"reset": (("low", "high"),)},
        actions={
            "count": (("up", "down"),),
            "set": (),
        },
    )
    count = 0

    def recall(self, read: Ports, write: Ports) -> None:
        super().recall(read, write)
        self.count = read.last_status.value.count

    def look(self, read: Ports, tick: int) -> dict[str, str]:
        return {"count": "low" if self.count <= 0 else "high" if self.count >= 10 else "between"}

    def do_count(self, way: str) -> None:
        """Count one."""
        self.count += 1 if way == "up" else -1

    def do_set(self) -> None:
        """Go to an end."""
        self.count = 0 if self.words[1] == "low" else 10

    def give(self, write: Ports, tick: int) -> None:
        write.status.count = self.count
