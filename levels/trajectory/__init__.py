"""A trajectory level that follows a queue of motion requests: segments in joint or Cartesian space, blended."""

from rack.levels.trajectory.executor import TrajectoryExecutor

__all__ = ["TrajectoryExecutor"]
