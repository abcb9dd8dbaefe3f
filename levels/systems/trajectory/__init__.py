"""A trajectory level that carries out queued motion requests, and the level that plans them."""

from rack.levels.systems.trajectory.executor import TrajectoryExecutor
from rack.levels.systems.trajectory.meeting import MeetingTrajectoryExecutor
from rack.levels.systems.trajectory.planner import RequestExecutor, RequestPlanner

__all__ = ["MeetingTrajectoryExecutor", "RequestExecutor", "RequestPlanner", "TrajectoryExecutor"]
