"""Rehearsal of a program before anything moves: every move is planned as the level below will plan
it, and timed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from rack.levels.algebra import Array
from rack.levels.level import LevelContext
from rack.levels.messages import SEGMENTS, WINDOW, Verb
from rack.levels.planning.moves import Move, Situation
from rack.levels.planning.pose import Pose
from rack.levels.task.program import TaskParams

if TYPE_CHECKING:  # it imports OMPL, which only a planner's process needs
    from rack.levels.planning.motion_planner import MotionPlanner


class Rehearsed(NamedTuple):
    """A move and the longest time that its motion takes."""

    move: Move
    duration_s: float  # 0 for the gripper


@dataclass(frozen=True)
class Rehearsal:
    """The result of a sequence of moves. Immutable: `then` returns a new one, so alternatives can
    start from here.
    """

    motion: MotionPlanner
    q: Array  # configuration at the end, (joints,), rad
    situation: Situation
    moves: tuple[Rehearsed, ...] = ()

    def then(
        self,
        action: int,
        verb: Verb,
        *,
        tool: Pose | None = None,
        row: int | None = None,
        joints: Array | None = None,
    ) -> Rehearsal:
        """Return the rehearsal after one more move; `joints` is its goal, or the posture at `tool`.

        Without `tool` the move ends at `joints`, or where the tool is. Raises `Refused` when the
        move cannot be done.
        """
        ends_at = self.q if joints is None else joints
        if tool is None:
            tool = self.motion.ik.tool_at(ends_at)
        move = Move(
            id=len(self.moves) + 1,
            action=action,
            verb=verb,
            object=row,
            tool=tool,
            joints=ends_at,
            posture=verb is Verb.MOVE and joints is not None,
            by_s=0.0,
        )
        if not move.is_motion:
            return replace(
                self,
                situation=self.situation.after(move),
                moves=(*self.moves, Rehearsed(move, 0.0)),
            )
        # One search is enough: the level below takes the quickest of several, this one among them.
        path = self.motion.plan(move, self.q, self.situation, searches=1)
        rehearsed = Rehearsed(move, self.motion.paths.duration(path))
        return replace(self, q=path.end, moves=(*self.moves, rehearsed))


def finish_times(
    moves: Sequence[Rehearsed], visible_s: float, context: LevelContext, needs: TaskParams
) -> list[float]:
    """Return for every move the latest simulated time, in s, at which the task level reads that it
    is done.

    `visible_s` is when the first window of moves becomes visible below. A move begins when the one
    before it is done, its path is planned, and the window of segments has room for it; each message
    waits at most one cycle to be read and one to be seen. The result assumes that nothing is in the
    way.
    """
    (pace,) = context.below.values()
    below = pace.every * context.tick_s
    done: list[float] = []
    planned = visible_s
    for k, (move, duration_s) in enumerate(moves):
        shown = visible_s
        if k >= WINDOW:
            shown = max(visible_s, done[k - WINDOW] + 2.0 * below + 2.0 * context.period_s)
        if move.is_motion:
            # The planner makes one plan after the other; only a move that it has waited for costs a
            # cycle more.
            planned = max(planned, shown + below) + below * pace.within_cycles
        at_hand = max(planned, shown) if move.is_motion else shown
        room = done[k - SEGMENTS] + below if k >= SEGMENTS else 0.0
        arrives = max(at_hand, room) + 2.0 * below
        before = done[-1] if done else 0.0
        begun = max(arrives + needs.beginning, before)
        lasts_s = duration_s + needs.settling if move.is_motion else needs.gripping
        end = begun + lasts_s
        # A move with a time is stretched to end just before it: the next one begins no sooner.
        done.append(max(end, move.by_s - 2.0 * below))
    return [time_s + 2.0 * below + context.period_s for time_s in done]
