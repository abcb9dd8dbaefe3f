"""Two levels, one of which breaks determinism."""

from time import monotonic

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output
from rack.levels.messages import ServoStatus


class SmoothStatus(Status, version=1):
    """The speed of the arm, smoothed."""

    speed: float = field(unit="rad/s", doc="speed of the arm, smoothed")


class RisesStatus(Status, version=1):
    """Number of times at which the speed began to rise."""

    rises: int = field(unit="1", doc="number of times at which the speed began to rise")


TIME_CONSTANT_S = 0.1


class Smooth(Executor):
    """A low-pass filter of the fastest joint's speed."""

    servo = Input(ServoStatus, "servo.status")
    status = Output(SmoothStatus)

    def __init__(self, context):
        super().__init__(context)
        self.before_s = monotonic()

    def process(self, tick):
        now_s = monotonic()
        part = (now_s - self.before_s) / TIME_CONSTANT_S
        self.before_s = now_s
        speed = abs(self.servo.message.velocity).max()
        self.status.state = State.EXECUTING
        self.status.speed += min(part, 1.0) * (speed - self.status.speed)


class Rises(Executor):
    """Counts how often the smoothed speed begins to rise."""

    smooth = Input(SmoothStatus, "smooth.status")
    status = Output(RisesStatus)

    def __init__(self, context):
        super().__init__(context)
        self.speed = 0.0
        self.is_rising = False

    def process(self, tick):
        speed = self.smooth.message.speed
        is_rising = speed > self.speed
        self.status.state = State.EXECUTING
        self.status.rises += is_rising and not self.is_rising
        self.speed = speed
        self.is_rising = is_rising
