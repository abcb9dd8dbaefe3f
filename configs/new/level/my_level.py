"""A level of your own: what it reads, what it writes, and what it does in every cycle.

`rack.levels.level` says what a level must do, and what it may.
"""

from __future__ import annotations

from rack.backplane.message import State, field
from rack.levels import AnsweringStatus, Executor, FindingKind, Input, Live, Output, Positive, Table
from rack.levels.messages import ServoStatus


class MyLevelParams(Table):
    """What `[board.my_level.params]` may hold."""

    limit: Live[Positive] = 2.0
    """speed of a joint from which it is reported [rad/s]"""


class MyLevelStatus(AnsweringStatus, version=1):
    """What the level writes in every cycle. The version rises when the fields change."""

    speed: float = field(unit="rad/s", doc="speed of the fastest joint")


class MyLevel(Executor):
    """Watches how fast the joints move."""

    servo = Input(ServoStatus, "servo.status")
    status = Output(MyLevelStatus)
    fast = FindingKind(unit="rad/s", doc="a joint is faster than the limit")
    params = MyLevelParams
    settings: MyLevelParams

    def process(self, tick: int) -> None:
        """Do one cycle: read the inputs, fill the outputs."""
        status = self.status
        status.state = State.EXECUTING
        status.speed = float(abs(self.servo.message.velocity).max())
        if status.speed > self.settings.limit:
            self.raise_finding("fast", status.speed, unit="rad/s")
