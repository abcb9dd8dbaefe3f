"""A level to start from: its inputs, its outputs, and one method that runs every cycle.

`rack.levels.level` documents what a level must do, and what it may do.
"""

from __future__ import annotations

from rack.backplane.message import State, field
from rack.levels import AnsweringStatus, Executor, FindingKind, Input, Live, Output, Positive, Table
from rack.levels.messages import ServoStatus


class MyLevelParams(Table):
    """Keys of `[board.my_level.params]`."""

    limit: Live[Positive] = 2.0
    """speed of a joint from which it is reported [rad/s]"""


class MyLevelStatus(AnsweringStatus, version=1):
    """Message that the level writes in every cycle. Raise its version when the fields change."""

    speed: float = field(unit="rad/s", doc="speed of the fastest joint")


class MyLevel(Executor):
    """Watches the speed of the joints."""

    servo = Input(ServoStatus, "servo.status")
    status = Output(MyLevelStatus)
    fast = FindingKind(unit="rad/s", doc="a joint is faster than the limit")
    params = MyLevelParams
    settings: MyLevelParams

    def process(self, tick: int) -> None:
        """Run one cycle: read the inputs, and fill the outputs."""
        status = self.status
        status.state = State.EXECUTING
        status.speed = float(abs(self.servo.message.velocity).max())
        if status.speed > self.settings.limit:
            self.raise_finding("fast", status.speed, unit="rad/s")
