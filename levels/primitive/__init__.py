"""The primitive level: turns paths into one jerk-limited joint set point per cycle.

Its planner times the paths in the background.
"""

from rack.levels.primitive.executor import PrimitiveExecutor
from rack.levels.primitive.planner import PrimitivePlanner

__all__ = ["PrimitiveExecutor", "PrimitivePlanner"]
