"""The servo level: computes torques at the clock's rate from set points of the level above.

Your own law derives from `ServoLaw`.
"""

from rack.levels.servo.control import LawParams
from rack.levels.servo.curves import Motion, SensedMotion
from rack.levels.servo.law import ServoExecutor, ServoLaw
from rack.levels.servo.modification import Hook, LawContext, LawSample, Modification
from rack.levels.servo.planner import ServoPlanner

__all__ = [
    "Hook",
    "LawContext",
    "LawParams",
    "LawSample",
    "Modification",
    "Motion",
    "SensedMotion",
    "ServoExecutor",
    "ServoLaw",
    "ServoPlanner",
]
