"""The primitive level: paths become jerk-limited joint set points, one a cycle, timed in the background."""

from levels.primitive.executor import PrimitiveExecutor
from levels.primitive.planner import PrimitivePlanner

__all__ = ["PrimitiveExecutor", "PrimitivePlanner"]
