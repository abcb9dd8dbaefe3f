"""The servo level: torques at the clock's rate from set points of the level above."""

from rack.levels.servo.executor import ServoExecutor
from rack.levels.servo.modification import Hook, LawContext, LawSample, Modification
from rack.levels.servo.planner import ServoPlanner

__all__ = ["Hook", "LawContext", "LawSample", "Modification", "ServoExecutor", "ServoPlanner"]
