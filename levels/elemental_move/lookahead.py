"""What the planner of the elemental move level works on next, and what it takes for true when that begins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.messages import SegmentKind, Verb
from rack.levels.planning.move import Move
from rack.levels.planning.path import Path
from rack.levels.planning.pose import Pose
from rack.levels.planning.situation import Situation

Array = NDArray[np.float64]


class Job(NamedTuple):
    """One plan to make: of `move` from `start` (joints,), rad. `goal`: the end to keep; `request`: what it answers."""

    move: Move
    start: Array
    goal: Array | None = None
    request: int = 0


class Published(NamedTuple):
    """A path handed to the executor, and the tick from which it is visible there."""

    move: Move
    path: Path
    visible_at: int


class Refusal(NamedTuple):
    """A job without a path: in which revision of the world, and the tick from which it is tried again all the same."""

    move: int
    request: int
    error: int
    revision: int
    again_at: int


def next_move(window: Sequence[Move], newest: int) -> Move | None:
    """Return the first motion behind move `newest`; None when the window does not reach it without a gap."""
    for move in window:
        if move.id == newest + 1:
            if move.is_motion:
                return move
            newest = move.id
    return None


def end_handed_down(command: Message, move: Move) -> Array | None:
    """Return where the path of `move` in a `MOVE_COMMAND` ends, (joints,), rad; None: it is not in there."""
    for segment in command.segments[: command.count]:
        if segment["move"] == move.id and segment["kind"] == SegmentKind.PATH:
            return np.array(segment["waypoints"][segment["count"] - 1])
    return None


def situation_before(
    move: Move, window: Sequence[Move], world: Message, held: int, grip: Pose | None, done: int
) -> Situation:
    """Return the situation when `move` begins: the world as sensed, and what the moves before it will change.

    `held` is the row in the gripper now, -1 for none, at `grip`; moves up to `done` have already changed the world.
    """
    situation = Situation(np.array(world.position), np.array(world.quaternion))
    if held >= 0:
        situation = situation.holding(held, grip)
    for earlier in window:
        # News of a grasp or release may come later than what it changed: then it must not count twice.
        known = earlier.verb is Verb.GRASP and earlier.object == situation.held
        if done < earlier.id < move.id and not known:
            situation = situation.after(earlier)
    return situation
