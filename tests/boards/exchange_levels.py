"""A level for tests of the exchange: it notes what each of its ports showed."""

from __future__ import annotations

from wave_levels import WAVE

from rack.backplane.message import Field, State, status
from rack.levels.level import Executor, Input, Ports

PORTS = ("plain", "sparse", "early")
NOTES = status(
    "notes",
    1,
    Field("value", "f8", "1", "value that each port showed", (len(PORTS),)),
    Field("verdict", "u1", "1", "verdict of each port", (len(PORTS),)),
    Field("lost", "u1", "1", "1: the port said that its writer is lost", (len(PORTS),)),
)


class Notes(Executor):
    """Reads one status by three ports, and notes what they show."""

    inputs = {port: Input(WAVE, "below.status") for port in PORTS}
    outputs = {"status": NOTES}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        write.status.state = State.EXECUTING
        for at, port in enumerate(PORTS):
            reading = getattr(read, port)
            write.status.value[at] = reading.value.value
            write.status.verdict[at] = reading.verdict
            write.status.lost[at] = reading.is_lost


class Exchanging(Notes):
    """A level that has taken the exchange's name."""

    outputs = {"status": NOTES, "exchange": NOTES}
