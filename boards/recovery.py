"""Recovery: restarts boards that were lost, as the policy permits, in the order of their dependence."""

from __future__ import annotations

from collections.abc import Mapping

from rack.backplane.address_map import CLOCK
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.crate_line import CrateLine
from rack.boards.crate_messages import PowerOff, PowerOn
from rack.boards.supervision import Restart, Supervision
from rack.boards.wiring import ClockWiring, TaskWiring


class Recovery:
    """The lost boards of one run, from their loss to their return.

    A board is powered on again when everything that it depends on is there; the clock takes it up on the grid.
    """

    def __init__(
        self,
        segment: Segment,
        supervision: Supervision,
        wirings: Mapping[str, TaskWiring | ClockWiring],
        crate: CrateLine,
    ) -> None:
        self._segment, self._supervision, self._wirings, self._crate = segment, supervision, wirings, crate
        self._waiting: list[str] = []
        self._starting: list[str] = []

    def lose(self, board: str, tick: int) -> Restart | None:
        """Take up a board whose process has ended; None when it is given up."""
        self._starting = [name for name in self._starting if name != board]
        restart = self._supervision.admit(board, tick)
        if restart is not None:
            self._waiting.append(board)
        elif board != CLOCK:
            # From here the clock knows: it brakes the arm and ends the run.
            self._segment.block(board)[Block.STATE] = TaskState.GIVEN_UP
        return restart

    def end_hanging(self, board: str) -> None:
        """Kill a board that hangs; its end is then told as any other's. One that is being restarted is left alone."""
        if board not in (*self._waiting, *self._starting):
            self._crate.ask(PowerOff(board))

    def advance(self) -> list[str]:
        """Power on what is due; return those boards."""
        self._starting = [name for name in self._starting if self._is_absent(name)]
        due = []
        for board in self._supervision.in_order(self._waiting):
            absent = [name for name in (*self._waiting, *self._starting) if name != board]
            if not self._supervision.must_wait(board, absent):
                due.append(board)
        for board in due:
            self._waiting.remove(board)
            self._starting.append(board)
            self._crate.ask(PowerOn(board, self._wirings[board]))
        return due

    def _is_absent(self, board: str) -> bool:
        if board == CLOCK:
            return False
        return self._segment.block(board)[Block.STATE] not in (TaskState.READY, TaskState.RUNNING)
