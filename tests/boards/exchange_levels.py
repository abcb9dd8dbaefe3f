"""A level for tests of the exchange, which records the content of each of its ports."""

from __future__ import annotations

import numpy as np
from wave_levels import WaveStatus

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output, Reading

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
