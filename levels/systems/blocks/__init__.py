"""Function blocks that are wired by data flow, also while they run, and a motion they can stop."""

from rack.levels.systems.blocks.executor import BlockExecutor, WiredMotion

__all__ = ["BlockExecutor", "WiredMotion"]
