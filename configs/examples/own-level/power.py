from rack.backplane.message import Field, State, status
from rack.levels.level import Executor, Input
from rack.levels.messages import SERVO_STATUS

POWER = status(
    "power_status",
    1,
    Field("power", "f8", "W", "mechanical power"),
    Field("energy", "f8", "J", "spent"),
)


class PowerMeter(Executor):
    """What the arm takes, from torque and velocity."""

    inputs = {"servo": Input(SERVO_STATUS, "servo.status")}
    outputs = {"status": POWER}

    def process(self, read, write, tick):
        arm = read.servo.value
        meter = write.status
        meter.state = State.EXECUTING
        meter.power = float((arm.torque * arm.velocity).sum())
        meter.energy += max(meter.power, 0.0) * self.context.period_s
