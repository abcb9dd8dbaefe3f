"""A program played through in the mind: every move planned as the level below will plan it, with its duration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rack.levels.messages import Verb
from rack.levels.planning.motion import MotionPlanner
from rack.levels.planning.move import Move
from rack.levels.planning.pose import Pose
from rack.levels.planning.situation import Situation
from rack.levels.task.finish import Rehearsed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rehearsal:
    """Where a sequence of moves has led: configuration `q` (joints,), rad, situation, and the moves so far.

    It does not change: `then` returns the next one, so that another way can be tried from the same point.
    """

    motion: MotionPlanner
    q: Array
    situation: Situation
    moves: tuple[Rehearsed, ...] = ()

    def then(
        self, action: int, verb: Verb, tool: Pose | None = None, row: int | None = None, joints: Array | None = None
    ) -> Rehearsal:
        """Return the rehearsal behind one more move; `joints` is its goal, or the posture at `tool`.

        Without `tool` the move ends at `joints`, or where the tool is. Raises `Refused` when the move cannot be done.
        """
        ends_at = self.q if joints is None else joints
        move = Move(
            id=len(self.moves) + 1,
            action=action,
            verb=verb,
            object=row,
            tool=tool if tool is not None else self.motion.ik.tool_at(ends_at),
            joints=ends_at,
            posture=verb is Verb.MOVE and joints is not None,
            by_s=0.0,
        )
        if not move.is_motion:
            return replace(self, situation=self.situation.after(move), moves=(*self.moves, Rehearsed(move, 0.0)))
        # One search is enough: the level below takes the quickest of several, this one among them.
        path = self.motion.plan(move, self.q, self.situation, searches=1)
        rehearsed = Rehearsed(move, self.motion.paths.duration(path))
        return replace(self, q=path.end, moves=(*self.moves, rehearsed))
