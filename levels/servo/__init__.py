"""The servo level: torques at the clock's rate from set points at the rate of the level above."""

from rack.levels.servo.executor import ServoExecutor
from rack.levels.servo.planner import ServoPlanner

__all__ = ["ServoExecutor", "ServoPlanner"]
