"""A user's own level, with its own enum in its status and its own kind of fault: one record."""

from __future__ import annotations

from enum import IntEnum

from wave_levels import Watch

from rack.backplane.message import State, Status, field
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import KINDS, Kind, Parameter
from rack.boards.faults import drawing as draw
from rack.boards.faults.bounds import DELIVERY, write_bound
from rack.boards.faults.message_steps import MessageStep, Outgoing
from rack.levels.level import Executor, Input, Output

OPENS_AT = 40


class Valve(IntEnum):
    """State of the valve."""

    SHUT = 0
    OPEN = 3


class LoseEvery(MessageStep):
    """Loses every n-th message."""

    def send_message(self, message: Outgoing) -> None:
        if message.released // self.writer.spec.every % round(self.entry.parameters[0]) == 0:
            self.count_action(message)
            self.writer.lose_message()
        else:
            self.onward(message)


KINDS.add(
    Kind(
        name="lose-every",
        where="writer",
        means="every n-th message is lost",
        step=LoseEvery,
        parameters=(
            Parameter(
                "n", "messages", "the n", 4, 2, 8, is_whole=True, drawn=draw.uniform_integer(2, 4)
            ),
        ),
        detected_as=(Alarm.GAP,),
        bound=write_bound(1) + DELIVERY,
        lasts=draw.uniform_messages(8, 12),
    )
)


class GaugeStatus(Status, version=1, message="gauge"):
    """Status of a gauge."""

    valve: Valve = field(doc="its valve")
    value: float = field(unit="1", doc="0")


class Gauge(Executor):
    """Opens its valve at a tick."""

    status = Output(GaugeStatus)

    def process(self, tick: int) -> None:
        self.status.state = State.EXECUTING
        self.status.valve = Valve.OPEN if tick >= OPENS_AT else Valve.SHUT


class GaugeWatch(Watch):
    """Reads the gauge."""

    below = Input(GaugeStatus, Watch.below.source)
