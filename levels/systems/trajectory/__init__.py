"""A trajectory level that follows a queue of motion requests, and the planning level that queues
them.

Names are imported on first use: tools that read the messages need not wait for the levels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.levels.systems.trajectory.executor import TrajectoryExecutor
    from rack.levels.systems.trajectory.planner import RequestExecutor, RequestPlanner

__all__ = ["RequestExecutor", "RequestPlanner", "TrajectoryExecutor"]
_PLACES = {
    "rack.levels.systems.trajectory.executor": ("TrajectoryExecutor",),
    "rack.levels.systems.trajectory.planner": ("RequestExecutor", "RequestPlanner"),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
