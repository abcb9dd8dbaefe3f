"""Your own level: it finds the greatest speed of any joint."""

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output
from rack.levels.messages import ServoStatus


class PeakStatus(Status, version=1):
    """The greatest speed of a joint so far."""

    speed: float = field(unit="rad/s", doc="greatest speed of a joint so far")


class Peak(Executor):
    """Keeps the greatest speed in the status of the servo level."""

    servo = Input(ServoStatus, "servo.status")
    status = Output(PeakStatus)

    def process(self, tick):
        speed = abs(self.servo.message.velocity).max()
        self.status.state = State.EXECUTING
        self.status.speed = max(self.status.speed, speed)
