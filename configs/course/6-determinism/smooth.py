"""Two levels; with one of them a rack does not repeat."""

from time import monotonic

from rack.backplane.message import Field, State, status
from rack.levels.level import Executor, Input
from rack.levels.messages import SERVO_STATUS

SMOOTH = status("smooth_status", 1, Field("speed", "f8", "rad/s", "speed of the arm, smoothed"))
RISES = status("rises_status", 1, Field("rises", "i8", "1", "how often the speed has risen"))
TIME_CONSTANT_S = 0.1


class Smooth(Executor):
    """A low-pass filter of the fastest joint's speed."""

    inputs = {"servo": Input(SERVO_STATUS, "servo.status")}
    outputs = {"status": SMOOTH}

    def __init__(self, context):
        super().__init__(context)
        self.before_s = monotonic()

    def process(self, read, write, tick):
        now_s = monotonic()
        part = (now_s - self.before_s) / TIME_CONSTANT_S
        self.before_s = now_s
        speed = abs(read.servo.value.velocity).max()
        write.status.state = State.EXECUTING
        write.status.speed += min(part, 1.0) * (speed - write.status.speed)


class Rises(Executor):
    """Counts how often the smoothed speed begins to rise."""

    inputs = {"smooth": Input(SMOOTH, "smooth.status")}
    outputs = {"status": RISES}

    def __init__(self, context):
        super().__init__(context)
        self.speed = 0.0
        self.is_rising = False

    def process(self, read, write, tick):
        speed = read.smooth.value.speed
        is_rising = speed > self.speed
        write.status.state = State.EXECUTING
        write.status.rises += is_rising and not self.is_rising
        self.speed = speed
        self.is_rising = is_rising
