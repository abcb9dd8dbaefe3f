"""A level of one's own: the greatest speed of any joint so far."""

from rack.backplane.message import Field, State, status
from rack.levels.level import Executor, Input
from rack.levels.messages import SERVO_STATUS

PEAK = status("peak_status", 1, Field("speed", "f8", "rad/s", "greatest speed of a joint so far"))


class Peak(Executor):
    """Reads the servo level's status, and keeps the greatest speed in it."""

    inputs = {"servo": Input(SERVO_STATUS, "servo.status")}
    outputs = {"status": PEAK}

    def process(self, read, write, tick):
        speed = abs(read.servo.value.velocity).max()
        write.status.state = State.EXECUTING
        write.status.speed = max(write.status.speed, speed)
