"""Kills from outside: the campaign sends SIGKILL to a board's process, and no fault tool has a part in it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.process import is_alive, start_time
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.tools.campaign.plan import Kill

LOOK_S = 0.001
"""In lockstep time has no grid to sleep on: how often the tick is looked at."""
RETRY_S = 0.02
"""How soon a board that is just being restarted is tried again."""


@dataclass(frozen=True)
class Killed:
    """A kill as it was done: at `tick`, and at CLOCK_MONOTONIC `time_ns`."""

    board: str
    tick: int
    time_ns: int


class Killer:
    """Kills boards of one rack at their instants. `done` are the kills so far."""

    def __init__(self, segment: Segment, kills: Sequence[Kill]) -> None:
        self._segment, self._words = segment, segment.words
        self._waiting = list(kills)
        self._retry_at = 0.0
        self.done: list[Killed] = []

    def due_in_s(self) -> float:
        """Return for how long nothing is to be done; at most half a second."""
        if not self._waiting:
            return 0.5
        if self._words[System.LOCKSTEP]:
            return LOOK_S
        at = max(self._instant_ns() * 1e-9, self._retry_at)
        return min(0.5, max(0.0, at - time.monotonic()))

    def advance(self) -> None:
        """Kill the board whose instant has come; one that cannot be killed just now, as soon as it can."""
        if not self._waiting or self._words[System.TICK] < self._waiting[0].tick or time.monotonic() < self._retry_at:
            return
        self._await_phase()
        kill = self._waiting[0]
        if self._kill(kill.board):
            self._waiting.pop(0)
        else:
            self._retry_at = time.monotonic() + RETRY_S

    def _await_phase(self) -> None:
        # In lockstep the phase only spreads kills over what boards do in their ticks.
        kill, period = self._waiting[0], self._words[System.PERIOD_NS]
        lockstep = self._words[System.LOCKSTEP]
        until = time.monotonic_ns() + round(kill.phase * period) if lockstep else self._instant_ns()
        time.sleep(max(0, until - time.monotonic_ns()) * 1e-9)

    def _instant_ns(self) -> int:
        kill, words = self._waiting[0], self._words
        return words[System.EPOCH_NS] + round((kill.tick + kill.phase) * words[System.PERIOD_NS])

    def _kill(self, board: str) -> bool:
        pid, is_up = self._process(board)
        if not is_up or not is_alive(pid):
            return False
        started = start_time(pid)
        with suppress(ProcessLookupError):
            descriptor = os.pidfd_open(pid)
            try:
                # The number may have come back as another process between the two looks.
                if (pid, True) == self._process(board) and is_alive(pid, started):
                    tick, now = self._words[System.TICK], time.monotonic_ns()
                    signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                    self.done.append(Killed(board, tick, now))
                    return True
            finally:
                os.close(descriptor)
        return False

    def _process(self, board: str) -> tuple[int, bool]:
        """Return a board's process, and whether it is at work."""
        if board == CLOCK:
            return self._words[System.CLOCK_PID], True
        block = self._segment.block(board)
        return block[Block.PID], block[Block.STATE] == TaskState.RUNNING and not block[Block.LOST]
