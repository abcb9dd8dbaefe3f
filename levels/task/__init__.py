"""The task level, which decomposes a program of actions on objects into elemental moves."""

from rack.levels.task.executor import TaskExecutor
from rack.levels.task.planner import TaskPlanner
from rack.levels.task.program import TaskConfig, read_program

__all__ = ["TaskConfig", "TaskExecutor", "TaskPlanner", "read_program"]
