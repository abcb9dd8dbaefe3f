"""The elemental move level: plans collision-free joint paths for moves before they are due."""

from rack.levels.elemental_move.executor import ElementalMoveExecutor
from rack.levels.elemental_move.planner import ElementalMovePlanner

__all__ = ["ElementalMoveExecutor", "ElementalMovePlanner"]
