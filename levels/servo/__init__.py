"""The servo level: torques at the rate of the clock from set points at the rate of the level above."""

from levels.servo.executor import ServoExecutor
from levels.servo.planner import ServoPlanner

__all__ = ["ServoExecutor", "ServoPlanner"]
