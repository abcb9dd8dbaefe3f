"""The task level: a program of actions on objects becomes elemental moves."""

from levels.task.executor import TaskExecutor
from levels.task.planner import TaskPlanner
from levels.task.program import TaskConfig, read_program

__all__ = ["TaskConfig", "TaskExecutor", "TaskPlanner", "read_program"]
