"""A level of one's own: the greatest speed of any joint so far."""

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input
from rack.levels.messages import ServoStatus


class PeakStatus(Status, version=1):
    """The greatest speed of a joint so far."""

    speed: float = field(unit="rad/s", doc="greatest speed of a joint so far")


class Peak(Executor):
    """Reads the servo level's status, and keeps the greatest speed in it."""

    inputs = {"servo": Input(ServoStatus, "servo.status")}
    outputs = {"status": PeakStatus}

    def process(self, read, write, tick):
        speed = abs(read.servo.value.velocity).max()
        write.status.state = State.EXECUTING
        write.status.speed = max(write.status.speed, speed)
