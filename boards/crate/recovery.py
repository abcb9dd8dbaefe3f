"""Recovery of lost boards: the limit and the order of restarts, and the restart itself."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.crate.requests import PowerOff, PowerOn
from rack.boards.wiring import ClockWiring, TaskWiring


class Restart(NamedTuple):
    """A restart that the policy permits: the `number`-th of at most `most` within `within_s`, s."""

    number: int
    most: int
    within_s: float

    def __str__(self) -> str:
        return f"restart {self.number} of at most {self.most} in {self.within_s:g} s"


class Supervision:
    """The restart policy of a rack. It counts in ticks, so that in lockstep the same losses have
    the same outcome."""

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self._config = config
        self._layout = layout
        self._restarts: dict[str, list[int]] = defaultdict(list)
        self._needs: dict[str, set[str]] = {CLOCK: set()}
        for task in layout.tasks:
            below = config.all_below(task.board)
            needed = {other.name for other in layout.tasks if other.board in below}
            self._needs[task.name] = {CLOCK, *needed} | (
                {task.board} if task.role == "planner" else set()
            )

    def admit(self, task: str, tick: int) -> Restart | None:
        """Count one more restart of a task, lost at `tick`; return None if no more are
        permitted."""
        most, within_s = self._policy(task)
        since = tick - within_s * 1e9 / self._layout.clock_ns
        recent = [at for at in self._restarts[task] if at > since]
        if len(recent) >= most:
            return None
        self._restarts[task] = [*recent, tick]
        return Restart(len(recent) + 1, most, within_s)

    def in_order(self, tasks: list[str]) -> list[str]:
        """Return the tasks in order of restart: the clock, then lower levels before higher,
        executor before planner."""
        # What a task needs, needs less than it does.
        return sorted(tasks, key=lambda task: len(self._needs[task]))

    def must_wait(self, task: str, absent: list[str]) -> bool:
        """Say whether a task on which this one depends is still absent: any below it, or a
        planner's executor."""
        return not self._needs[task].isdisjoint(absent)

    def _policy(self, task: str) -> tuple[int, float]:
        common = self._config.supervision
        if task == CLOCK:
            return common.restarts, common.within_s
        spec = self._layout.task(task)
        config = self._config
        board = config.host[task] if spec.role == "host" else config.board[spec.board]
        most = common.restarts if board.restarts is None else board.restarts
        return most, common.within_s if board.restarts_within_s is None else board.restarts_within_s


class Recovery:
    """The lost boards of a run, from loss to return.

    A board is powered on again once everything on which it depends is present; it rejoins on the
    clock's grid.
    """

    def __init__(
        self,
        segment: Segment,
        supervision: Supervision,
        wirings: Mapping[str, TaskWiring | ClockWiring],
        crate: CrateLine,
    ) -> None:
        self._segment = segment
        self._supervision = supervision
        self._wirings = wirings
        self._crate = crate
        self._waiting: list[str] = []
        self._starting: list[str] = []

    def lose(self, board: str, tick: int, is_final: bool = False) -> Restart | None:
        """Schedule the restart of a board whose process has ended; return None if it is given up,
        as one `is_final`."""
        self._starting = [name for name in self._starting if name != board]
        restart = None if is_final else self._supervision.admit(board, tick)
        if restart is not None:
            self._waiting.append(board)
        elif board != CLOCK:
            # The clock reacts to this: it brakes the arm and ends the run.
            self._segment.block(board)[Block.STATE] = TaskState.GIVEN_UP
        return restart

    def end_hanging(self, board: str) -> None:
        """Kill a hanging board, which is then lost like any other; one that is being restarted is
        left alone."""
        if board not in (*self._waiting, *self._starting):
            self._crate.ask(PowerOff(board))

    def advance(self) -> list[str]:
        """Power on the boards that are due; return them."""
        self._starting = [name for name in self._starting if self._is_absent(name)]
        absent = [*self._waiting, *self._starting]
        in_order = self._supervision.in_order(self._waiting)
        due = [board for board in in_order if not self._supervision.must_wait(board, absent)]
        for board in due:
            self._waiting.remove(board)
            self._starting.append(board)
            self._crate.ask(PowerOn(board, self._wirings[board]))
        return due

    def _is_absent(self, board: str) -> bool:
        if board == CLOCK:
            return False
        return self._segment.block(board)[Block.STATE] not in (TaskState.READY, TaskState.RUNNING)
