"""Task levels of several racks that work together: one that takes its actions as orders, and one that gives them."""

from rack.levels.cell.messages import CELL_ORDER, CELL_REPORT

__all__ = ["CELL_ORDER", "CELL_REPORT"]
