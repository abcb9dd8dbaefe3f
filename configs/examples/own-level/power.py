from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output
from rack.levels.messages import ServoStatus


class PowerStatus(Status, version=1):
    """Power drawn by the arm."""

    power: float = field(unit="W", doc="mechanical power")
    energy: float = field(unit="J", doc="spent")


class PowerMeter(Executor):
    """Computes the power and energy that the arm takes, from torque and velocity."""

    servo = Input(ServoStatus, "servo.status")
    status = Output(PowerStatus)

    def process(self, tick):
        arm = self.servo.message
        meter = self.status
        meter.state = State.EXECUTING
        meter.power = float((arm.torque * arm.velocity).sum())
        meter.energy += max(meter.power, 0.0) * self.context.period_s
