"""What the task level shows of its plan: a window of moves, under ids that rise whatever an operator puts between."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.messages import WINDOW, Verb
from rack.levels.planning.move import Move

JUMP = 2
"""From the newest id shown to the next, where the level below must start anew: behind its own by more than one."""
FIRST = 1
"""Id of the plan's first move, as long as no operator has come between."""
FREE = (Verb.MOVE, Verb.MOVE_JOINTS)
"""Moves that may be left under way and done again later, wherever the arm has been meanwhile."""


class ShownWindow:
    """Numbers the moves of the plan on the bus: the plan's `k`-th is `first` + k; `newest` is the newest id shown.

    The level below has begun anew once it has done `before`.
    """

    def __init__(self, first: int = FIRST, newest: int = 0, before: int = 0) -> None:
        self.first, self.newest, self.before = first, newest, before

    def jump(self) -> int:
        """Return an id with which the level below starts anew."""
        self.newest += JUMP
        self.before = self.newest - 1
        return self.newest

    def renumber(self, done: int) -> None:
        """Show the plan from its move `done` on, anew."""
        self.first = self.newest + JUMP - done
        self.before = self.first + done - 1

    def done(self, below: Message) -> int:
        """Return how many of the plan's moves the level below says are done."""
        return int(below.done) - self.first + 1

    def show(self, plan: Message, done: int, command: Message, until: int) -> None:
        """Show the moves from the first one that is not done to `until`; behind the last, the window stays.

        Moves that were done under other ids are not shown again: the level below would do them again.
        """
        first = min(done, max(plan.count - WINDOW, 0)) if self.first == FIRST else done
        count = max(0, min(WINDOW, until - first))
        command.moves[:count] = plan.moves[first : first + count]
        command.moves["id"][:count] = np.arange(count) + (self.first + first)
        self._end(command, count)

    def show_one(self, move: Move, command: Message) -> None:
        """Show one move alone."""
        move.write_to(command.moves[0])
        self._end(command, 1)

    def show_none(self, command: Message) -> None:
        """Withdraw all moves."""
        self._end(command, 0)

    def _end(self, command: Message, count: int) -> None:
        command.count = count
        # Equal windows have equal bytes.
        command.moves[count:] = np.zeros((), command.moves.dtype)
        if count:
            self.newest = max(self.newest, int(command.moves["id"][count - 1]))
        command.id = self.newest


def is_free(plan: Message, k: int) -> bool:
    """Say whether move `k` of the plan is a free motion; so is what lies before the first and behind the last."""
    return not 0 <= k < plan.count or int(plan.moves["verb"][k]) in FREE


def next_free(plan: Message, done: int) -> int:
    """Return the first move of the plan, from `done` on, that is a free motion; the end of the plan, if none is."""
    return next(k for k in range(done, plan.count + 1) if is_free(plan, k))
