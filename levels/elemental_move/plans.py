"""Plans that have come and wait until their move is due."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from backplane.mailbox import Reading
from backplane.message import Message
from levels.messages import WINDOW, Error, Verb

CAPACITY = 2 * WINDOW
"""Plans kept: the planner is never farther ahead than its window, and moves just done leave with the next plan."""


class PlansAtHand:
    """The newest plan of every move from the one under way on, and of the open request to plan anew."""

    def __init__(self) -> None:
        self._by_move: dict[int, Message] = {}
        self._anew: Message | None = None

    def take(self, plan: Reading, done: int, handed_down: int) -> None:
        """Take over a plan that is new, of a move behind the newest one handed down.

        Plans of moves before `done` are given up, and behind a refusal all.
        """
        if not plan.is_new:
            return
        message = Message(plan.value.record.dtype)
        message.copy_from(plan.value)
        if message.replan:
            self._anew = message
            return
        if message.move <= handed_down:
            return
        for move in [m for m in self._by_move if m < done or (message.error and m > message.move)]:
            del self._by_move[move]
        if len(self._by_move) < CAPACITY:
            self._by_move[message.move] = message

    def of(self, move: int) -> Message | None:
        """Return the plan of a move, which may be a refusal; None: not yet there."""
        return self._by_move.get(move)

    def anew(self, request: int) -> Message | None:
        """Return the answer to a request to plan anew; None: not yet there."""
        return self._anew if self._anew is not None and self._anew.replan == request else None

    def reach(self, window: Any, handed_down: int) -> int:
        """Return the newest move, at least `handed_down`, up to which every motion of `window` has its path."""
        reached = handed_down
        for move in window:
            if move["id"] == reached + 1:
                plan = self._by_move.get(int(move["id"]))
                has_path = plan is not None and plan.error == Error.NONE
                if not has_path and move["verb"] not in (Verb.GRASP, Verb.RELEASE):
                    break
                reached += 1
        return reached

    def end(self, move: int) -> NDArray[np.float64] | None:
        """Return where the newest path up to that of `move` ends, (joints,) in rad; None: no such path is at hand."""
        paths = [m for m, plan in self._by_move.items() if m <= move and plan.error == Error.NONE]
        if not paths:
            return None
        plan = self._by_move[max(paths)]
        return np.asarray(plan.waypoints[plan.count - 1])
