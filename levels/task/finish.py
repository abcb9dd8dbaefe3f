"""When each move of a program will be done, at the latest: the pipeline of the levels, worked out move by move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rack.levels.errors import LevelError
from rack.levels.level import LevelContext
from rack.levels.messages import SEGMENTS, WINDOW
from rack.levels.planning.move import Move
from rack.levels.task.params import TaskParams


class Rehearsed(NamedTuple):
    """A move and the time, in s, that its motion takes at most; 0 for the gripper's."""

    move: Move
    duration_s: float


class Cycles(NamedTuple):
    """Cycles in s: the task level's, that of the level below, and the time slice of a plan there."""

    own_s: float
    below_s: float
    planning_s: float


def cycles_of(context: LevelContext) -> Cycles:
    """Return the cycles that a promise of a time rests on. Raises `LevelError` where no level is below."""
    if context.below is None:
        raise LevelError(f"level '{context.board}' has no level below; it needs one to carry out its moves")
    below_s = context.below.every * context.tick_s
    return Cycles(context.period_s, below_s, below_s * context.below.within_cycles)


def finish_times(moves: Sequence[Rehearsed], visible_s: float, cycles: Cycles, needs: TaskParams) -> list[float]:
    """Return for every move the simulated time, in s, by which the task level knows that it is done.

    `visible_s` is when the first window of moves becomes visible below. A move begins when the one before it is done,
    its path is planned, and the window of segments has had room for it; each news waits at most one cycle to be read
    and one to be seen. Nothing must stand in the way.
    """
    below = cycles.below_s
    done: list[float] = []
    planned = visible_s
    for k, (move, duration_s) in enumerate(moves):
        shown = visible_s
        if k >= WINDOW:
            shown = max(visible_s, done[k - WINDOW] + 2.0 * below + 2.0 * cycles.own_s)
        if move.is_motion:
            # The planner goes from plan to plan; only a move that it has waited for costs it a cycle more.
            planned = max(planned, shown + below) + cycles.planning_s
        at_hand = max(planned, shown) if move.is_motion else shown
        room = done[k - SEGMENTS] + below if k >= SEGMENTS else 0.0
        arrives = max(at_hand, room) + 2.0 * below
        begun = max(arrives + needs.beginning, done[k - 1] if k else 0.0)
        end = begun + (duration_s + needs.settling if move.is_motion else needs.gripping)
        # A move with a time is stretched to end just before it: what comes behind it begins no sooner.
        done.append(max(end, move.by_s - 2.0 * below))
    return [time_s + 2.0 * below + cycles.own_s for time_s in done]
