"""The primitive level: paths become jerk-limited joint set points, one per cycle, timed in the
background.
"""

from rack.levels.primitive.executor import PrimitiveExecutor
from rack.levels.primitive.planner import PrimitivePlanner

__all__ = ["PrimitiveExecutor", "PrimitivePlanner"]
