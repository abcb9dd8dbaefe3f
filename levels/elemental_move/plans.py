"""Plans that have come and wait until their move is due."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import Message
from rack.levels.messages import WINDOW, Error, Verb

SAME_PLACE_RAD = 0.005
"""Paths join where the end of one and the beginning of the next are not farther apart than this in any joint."""
CAPACITY = 2 * WINDOW
"""Plans kept: the planner is never farther ahead than its window, and moves just done leave with the next plan."""


class PlansAtHand:
    """The newest plan of every move from the one under way on, and of the open request to plan anew."""

    def __init__(self) -> None:
        self._by_move: dict[int, Message] = {}
        self._anew: Message | None = None

    def take(self, plan: Reading, done: int, handed_down: int, end: NDArray[np.float64]) -> None:
        """Take over a plan that is new, of a move behind the newest one handed down, if it begins where those end.

        `end` (joints,), rad, is where the moves end for which no plan is at hand any more. A plan that does not join
        rests on one that has been lost or made again; its planner makes it anew. Plans of moves before `done` are
        given up, and behind a refusal, or a path that ends elsewhere than the one before, all.
        """
        if not plan.is_new:
            return
        message = Message(plan.value.record.dtype)
        message.copy_from(plan.value)
        if message.replan:
            self._anew = message
            return
        for move in [m for m in self._by_move if m < done]:
            del self._by_move[move]
        before = self.end(message.move - 1)
        if message.move <= handed_down or not (message.error or joins(message, end if before is None else before)):
            return
        known = self._by_move.get(message.move)
        stays = known is not None and not (known.error or message.error) and is_same(end_of(known), end_of(message))
        for move in [m for m in self._by_move if m > message.move and not stays]:
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
        return end_of(self._by_move[max(paths)]) if paths else None


def joins(plan: Message, place: NDArray[np.float64]) -> bool:
    """Say whether the path of a `MOVE_PLAN` begins at `place` (joints,), rad."""
    return is_same(np.asarray(plan.waypoints[0]), place)


def end_of(plan: Message) -> NDArray[np.float64]:
    """Return where the path of a `MOVE_PLAN` ends, (joints,), rad."""
    return np.asarray(plan.waypoints[plan.count - 1])


def is_same(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Say whether two configurations (joints,), rad, are one place for a path to go on from."""
    return float(np.abs(a - b).max()) <= SAME_PLACE_RAD
