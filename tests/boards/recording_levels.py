"""Levels that record the content of each of their ports: for tests of the exchange, and of
interrupts."""

from __future__ import annotations

from time import process_time_ns

import numpy as np

from rack.backplane.message import Message, State, Status, field
from rack.backplane.process import busy_wait_until
from rack.levels.level import Executor, Input, Inputs, Output, Reading
from rack.levels.systems.figures import FigureStatus
from tests.boards.wave_levels import WaveStatus

BOARDS = 5
PORTS = ("plain", "sparse", "early")


class Noted(Status, version=1, message="notes"):
    """Notes."""

    value: np.ndarray = field(unit="1", doc="value that each port showed", shape=len(PORTS))
    verdict: np.ndarray = field("u1", unit="1", doc="verdict of each port", shape=len(PORTS))
    lost: np.ndarray = field(
        "u1", unit="1", doc="1: the port said that its writer is lost", shape=len(PORTS)
    )


class Notes(Executor):
    """Reads one status by three ports, and notes what they show."""

    plain = Input(WaveStatus, "below.status")
    sparse = Input(WaveStatus, "below.status")
    early = Input(WaveStatus, "below.status")
    status = Output(Noted)

    def process(self, tick: int) -> None:
        self.status.state = State.EXECUTING
        for at, port in enumerate(PORTS):
            reading: Reading[WaveStatus] = getattr(self, port)
            self.status.value[at] = reading.message.value
            self.status.verdict[at] = reading.verdict
            self.status.lost[at] = reading.is_lost


class Exchanging(Notes):
    """A level that has taken the exchange's name."""

    status = Output(Noted)
    exchange = Output(Noted)


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
