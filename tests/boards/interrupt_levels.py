"""A level for tests of interrupts, which records its message of each board below."""

from __future__ import annotations

from time import process_time_ns

import numpy as np

from rack.backplane.message import Message, State, Status, field
from rack.backplane.process import busy_wait_until
from rack.levels.level import Executor, Inputs, Output
from rack.levels.systems.figures import FigureStatus

BOARDS = 5


class Heard(Status, version=1):
    cycle: np.ndarray = field(
        "i8",
        unit="tick",
        doc="cycle that each board below reports; -1: none came yet",
        shape=BOARDS,
    )
    lost: np.ndarray = field("u1", unit="1", doc="1: the writer counts as lost", shape=BOARDS)


class Order(Message, version=1):
    number: int = field("u4", unit="1", doc="number of the order")


class Hub(Executor):
    """Reads the statuses of all boards below."""

    below = Inputs(FigureStatus, "below.status")
    status = Output(Heard, rests_on=below)
    command = Output(Order)

    def process(self, tick: int) -> None:
        busy_wait_until(process_time_ns() + self.context.params.get("compute_ns", 0))
        self.status.state = State.EXECUTING
        for at, reading in enumerate(self.below.values()):
            self.status.cycle[at] = reading.message.cycle if reading.has_message else -1
            self.status.lost[at] = reading.is_lost
        self.command.number = tick // self.context.every
