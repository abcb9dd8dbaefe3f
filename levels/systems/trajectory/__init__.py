"""A trajectory level that follows a queue of motion requests, and the planning level that queues
them.
"""

from rack.levels.systems.trajectory.executor import TrajectoryExecutor
from rack.levels.systems.trajectory.planner import RequestExecutor, RequestPlanner

__all__ = ["RequestExecutor", "RequestPlanner", "TrajectoryExecutor"]
