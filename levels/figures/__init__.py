"""The level of the paper's Gantt charts (section 3.4): it computes for given times, and nothing else."""

from rack.levels.figures.executor import FigureExecutor
from rack.levels.figures.planner import FigurePlanner

__all__ = ["FigureExecutor", "FigurePlanner"]
