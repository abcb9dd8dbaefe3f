"""The elemental move level: moves of the tool become collision-free joint paths, planned before
they are due.
"""

from rack.levels.elemental_move.executor import ElementalMoveExecutor
from rack.levels.elemental_move.planner import ElementalMovePlanner

__all__ = ["ElementalMoveExecutor", "ElementalMovePlanner"]
