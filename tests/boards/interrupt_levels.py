"""A level for tests of interrupts: it notes which message of each board below it has."""

from __future__ import annotations

from rack.backplane.message import Field, MessageType, State, status
from rack.levels.level import Executor, Input, Ports
from rack.levels.systems.figures import FIGURE_STATUS

BOARDS = 5
HEARD = status(
    "heard",
    1,
    Field(
        "cycle", "i8", "tick", "cycle that each board below reports; -1: none came yet", (BOARDS,)
    ),
    Field("lost", "u1", "1", "1: the writer counts as lost", (BOARDS,)),
)
ORDER = MessageType("order", 1, (Field("number", "u4", "1", "number of the order"),))


class Hub(Executor):
    """Reads the statuses of all boards below."""

    inputs = {"status": Input(FIGURE_STATUS, "below.status", many=True)}
    outputs = {"status": HEARD, "command": ORDER}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        write.status.state = State.EXECUTING
        for at, reading in enumerate(read.status.values()):
            write.status.cycle[at] = reading.value.cycle if reading.is_there else -1
            write.status.lost[at] = reading.is_lost
        write.command.number = tick // self.context.every
