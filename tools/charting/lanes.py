"""The rows of a Gantt chart: each holds the tasks of one board on one core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rack.levels.timing.tasks import TimedTask


@dataclass(frozen=True)
class Lane:
    """The tasks of one board on one core: an executor, with its planner where they are tightly coupled, or a planner.

    `cycle_ns` is the level's cycle, `slice_ns` what one plan may take; without a planner, one cycle.
    """

    core: int
    board: str
    executor: str | None
    planner: str | None
    priority: int
    cycle_ns: int
    slice_ns: int

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of its tasks."""
        return tuple(name for name in (self.executor, self.planner) if name is not None)

    @property
    def name(self) -> str:
        """The board's name; that of the planner where it is alone."""
        return self.tasks[0]

    @property
    def title(self) -> str:
        """Core and name."""
        return f"core {self.core}  {self.name}"

    @property
    def is_tight(self) -> bool:
        """Whether a planner shares the core with its executor."""
        return self.executor is not None and self.planner is not None


def lanes_of(tasks: Sequence[TimedTask]) -> tuple[Lane, ...]:
    """Return the lanes of `tasks`: by core, then the highest priority first."""
    places = dict.fromkeys((task.core, task.board) for task in tasks)
    lanes = [_lane(core, [t for t in tasks if (t.core, t.board) == (core, board)]) for core, board in places]
    return tuple(sorted(lanes, key=lambda lane: (lane.core, -lane.priority, lane.cycle_ns)))


def _lane(core: int, tasks: list[TimedTask]) -> Lane:
    planner = next((task for task in tasks if task.role == "planner"), None)
    executor = next((task for task in tasks if task.role != "planner"), None)
    return Lane(
        core=core,
        board=tasks[0].board,
        executor=executor.name if executor is not None else None,
        planner=planner.name if planner is not None else None,
        priority=max(task.priority for task in tasks),
        cycle_ns=tasks[0].every_ns,
        slice_ns=(planner or tasks[0]).period_ns,
    )
