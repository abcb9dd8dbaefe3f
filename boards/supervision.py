"""What becomes of boards that were lost: how often each may be restarted, and in which order they come back."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.boards.config.schema import RackConfig


class Restart(NamedTuple):
    """A restart that the policy admits: the `number`-th of at most `most` within `within_s`, s."""

    number: int
    most: int
    within_s: float


class Supervision:
    """The restart policy of a rack. Times are ticks: in lockstep, too, the same losses have the same end."""

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self._config, self._layout = config, layout
        self._restarts: dict[str, list[int]] = defaultdict(list)
        self._rank = {task.name: _rank(config, task.board, task.role == "planner") for task in layout.tasks}
        self._rank[CLOCK] = (0, False)

    def admit(self, task: str, tick: int) -> Restart | None:
        """Count one more restart of a task, lost at `tick`; None when its policy permits no more."""
        most, within_s = self._policy(task)
        since = tick - within_s * 1e9 / self._layout.clock_ns
        recent = [at for at in self._restarts[task] if at > since]
        if len(recent) >= most:
            return None
        self._restarts[task] = [*recent, tick]
        return Restart(len(recent) + 1, most, within_s)

    def in_order(self, tasks: list[str]) -> list[str]:
        """Return the tasks in the order of restart: the clock, lower levels before higher, planners last."""
        return sorted(tasks, key=lambda task: self._rank[task])

    def must_wait(self, task: str, absent: list[str]) -> bool:
        """Say whether one that the task depends on is still absent: everything below it, and a planner's executor."""
        return any(self._rank[other] < self._rank[task] for other in absent)

    def _policy(self, task: str) -> tuple[int, float]:
        common = self._config.supervision
        if task == CLOCK:
            return common.restarts, common.within_s
        board = self._config.board[self._layout.task(task).board]
        most = common.restarts if board.restarts is None else board.restarts
        return most, common.within_s if board.restarts_within_s is None else board.restarts_within_s


def _rank(config: RackConfig, board: str, is_planner: bool) -> tuple[int, bool]:
    """Return how many levels lie below a board, the clock counted."""
    depth, below = 1, config.board[board].below
    while below is not None:
        depth, below = depth + 1, config.board[below].below
    return depth, is_planner
