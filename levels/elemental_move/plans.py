"""Plans that have come and wait until their move is due."""

from __future__ import annotations

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
        """Take over a plan that is new. Plans of moves up to `done` are given up."""
        if not plan.is_new:
            return
        for move in [m for m in self._by_move if m <= done]:
            del self._by_move[move]
        message = Message(plan.value.record.dtype)
        message.copy_from(plan.value)
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

    def newest(self, move: int) -> int:
        """Return the newest move with a path in unbroken reach: `move`, or one behind it."""
        found = move
        for candidate in sorted(self._by_move):
            if candidate > found and self._by_move[candidate].error == Error.NONE:
                found = candidate
        return found
