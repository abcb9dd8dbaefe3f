"""Rehearsal of a program before anything moves.

Every move is planned as the level below will plan it, and its duration is computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from rack.levels.algebra import Array
from rack.levels.level import LevelContext
from rack.levels.messages import SEGMENTS, WINDOW_MOVES, Verb
from rack.levels.planning.moves import Move, Situation
from rack.levels.planning.pose import Pose
from rack.levels.task.program import TaskParams

# This imports OMPL, which only a planner's process needs.
if TYPE_CHECKING:
    from rack.levels.planning.motion_planner import MotionPlanner


class Rehearsed(NamedTuple):
    """A move and the longest duration of its motion."""

    move: Move
    duration_s: float  # 0 for the gripper


@dataclass(frozen=True)
class Rehearsal:
    """The state after a sequence of rehearsed moves.

    It is immutable, so that several alternatives can start from the same rehearsal.
    """

    motion: MotionPlanner
    q: Array  # configuration at the end, (joints,), rad
    situation: Situation
    moves: tuple[Rehearsed, ...] = ()

    def add_move(
        self,
        action: int,
        verb: Verb,
        *,
        tool: Pose | None = None,
        row: int | None = None,
        joints: Array | None = None,
    ) -> Rehearsal:
        """Return the rehearsal after one more move.

        Args:
            action: Number of the action.
            verb: Kind of the move.
            tool: Pose of the tool at the end. None if it follows from the joints.
            row: Row of the object in the world model. None if the move concerns none.
            joints: Joint positions at the end, (joints,), rad, or the preferred posture at `tool`.
                None to keep the present positions.

        Raises:
            Refused: The move cannot be done.
        """
        ends_at = self.q if joints is None else joints
        if tool is None:
            tool = self.motion.ik.compute_tool_pose(ends_at)
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
                situation=self.situation.predict_after(move),
                moves=(*self.moves, Rehearsed(move, 0.0)),
            )
        # One search is enough. The level below takes the quickest path of several searches, which
        # include this one.
        path = self.motion.plan(move, self.q, self.situation, searches=1)
        rehearsed = Rehearsed(move, self.motion.paths.compute_duration(path))
        return replace(self, q=path.end, moves=(*self.moves, rehearsed))


def compute_finish_times(
    moves: Sequence[Rehearsed], visible_s: float, context: LevelContext, needs: TaskParams
) -> list[float]:
    """Return, for each move, the latest time in s at which the task level reads that it is done.

    A move begins when the previous move is done, its path is planned, and the window of segments
    has space for it. Each message waits at most one cycle to be read and one to become visible. The
    result assumes that nothing blocks the motion.

    Args:
        moves: The moves.
        visible_s: Simulated time at which the level below sees the first window of moves, s.
        context: The task level.
        needs: Longest times that the levels below need.
    """
    (pace,) = context.below.values()
    below_s = pace.every * context.tick_s
    done_s: list[float] = []
    planned_s = visible_s
    for k, (move, duration_s) in enumerate(moves):
        shown_s = visible_s
        if k >= WINDOW_MOVES:
            shown_s = max(
                visible_s, done_s[k - WINDOW_MOVES] + 2.0 * below_s + 2.0 * context.period_s
            )
        if move.is_motion:
            # The planner computes one plan at a time. It needs another cycle only if it has to wait
            # for the move.
            planned_s = max(planned_s, shown_s + below_s) + below_s * pace.within_cycles
        ready_s = planned_s if move.is_motion else shown_s
        space_s = done_s[k - SEGMENTS] + below_s if k >= SEGMENTS else 0.0
        arrival_s = max(ready_s, space_s) + 2.0 * below_s
        previous_s = done_s[-1] if done_s else 0.0
        begin_s = max(arrival_s + needs.beginning, previous_s)
        length_s = duration_s + needs.settling if move.is_motion else needs.gripping
        # A move with a deadline is slowed to end just before it, which delays the next move.
        done_s.append(max(begin_s + length_s, move.by_s - 2.0 * below_s))
    return [time_s + 2.0 * below_s + context.period_s for time_s in done_s]
