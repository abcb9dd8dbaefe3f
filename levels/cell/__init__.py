"""Task levels of several racks that work together: one that takes its actions as orders, and one that gives them."""

from rack.levels.cell.coordinator import Coordinator
from rack.levels.cell.executor import OrderedTaskExecutor
from rack.levels.cell.messages import CELL_ORDER, CELL_REPORT
from rack.levels.cell.planner import OrderedTaskPlanner
from rack.levels.cell.program import CellProgram

__all__ = ["CELL_ORDER", "CELL_REPORT", "CellProgram", "Coordinator", "OrderedTaskExecutor", "OrderedTaskPlanner"]
