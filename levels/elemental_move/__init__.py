"""The elemental move level: moves of the tool become collision-free joint paths, planned ahead of their turn."""

from levels.elemental_move.executor import ElementalMoveExecutor
from levels.elemental_move.planner import ElementalMovePlanner

__all__ = ["ElementalMoveExecutor", "ElementalMovePlanner"]
