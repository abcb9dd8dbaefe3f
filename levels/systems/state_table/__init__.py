"""Levels programmed by state tables.

Their executors follow tables in TOML files. Plans are static, and no planner runs.
"""

from rack.levels.systems.state_table.elemental_move import MoveTable
from rack.levels.systems.state_table.level import StateTableExecutor
from rack.levels.systems.state_table.primitive import PrimitiveTable
from rack.levels.systems.state_table.task import TaskTable

__all__ = ["MoveTable", "PrimitiveTable", "StateTableExecutor", "TaskTable"]
