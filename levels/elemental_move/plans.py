"""Plans that have come and wait until their move is due."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backplane.mailbox import Reading
from backplane.message import Message
from levels.messages import WINDOW, Error

CAPACITY = 2 * WINDOW
"""Plans kept: the planner is never farther ahead than its window, and moves just done leave with the next plan."""


class PlansAtHand:
    """The newest plan of every move from the one under way on, and of the open request to plan anew."""

    def __init__(self) -> None:
        self._by_move: dict[int, Message] = {}
        self._anew: Message | None = None

    def take(self, plan: Reading, done: int) -> None:
        """Take over a plan that is new. Plans of moves before `done` are given up, behind a refusal all."""
        if not plan.is_new:
            return
        message = Message(plan.value.record.dtype)
        message.copy_from(plan.value)
        refused = message.error and not message.replan
        for move in [m for m in self._by_move if m < done or (refused and m > message.move)]:
            del self._by_move[move]
        if message.replan:
            self._anew = message
        elif message.move > done and len(self._by_move) < CAPACITY:
            self._by_move[message.move] = message

    def of(self, move: int) -> Message | None:
        """Return the plan of a move, which may be a refusal; None: not yet there."""
        return self._by_move.get(move)

    def anew(self, request: int) -> Message | None:
        """Return the answer to a request to plan anew; None: not yet there."""
        return self._anew if self._anew is not None and self._anew.replan == request else None

    def newest(self, handed_down: int) -> int:
        """Return the newest move whose path is at hand, at least `handed_down`."""
        return max([handed_down, *(m for m, plan in self._by_move.items() if plan.error == Error.NONE)])

    def end(self, move: int) -> NDArray[np.float64] | None:
        """Return where the newest path up to that of `move` ends, (joints,) in rad; None: no such path is at hand."""
        paths = [m for m, plan in self._by_move.items() if m <= move and plan.error == Error.NONE]
        if not paths:
            return None
        plan = self._by_move[max(paths)]
        return np.asarray(plan.waypoints[plan.count - 1])
