"""The servo level, on one board or several: torques at the clock's rate from set points of the level above."""

from rack.levels.servo.arm_executor import ArmExecutor
from rack.levels.servo.executor import ServoExecutor
from rack.levels.servo.gateway import JointGateway
from rack.levels.servo.joint_servo import JointServo
from rack.levels.servo.modification import Hook, LawContext, LawSample, Modification
from rack.levels.servo.planner import ServoPlanner
from rack.levels.servo.sharing import SharingServoExecutor

__all__ = [
    "ArmExecutor",
    "Hook",
    "JointGateway",
    "JointServo",
    "LawContext",
    "LawSample",
    "Modification",
    "ServoExecutor",
]
__all__ += ["ServoPlanner", "SharingServoExecutor"]
