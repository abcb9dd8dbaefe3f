"""Parameters of the elemental move level, its store of plans, and its window of segments."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import copy_message
from rack.levels.algebra import Array
from rack.levels.messages import (
    WINDOW_MOVES,
    Error,
    MoveCommand,
    MovePlan,
    SegmentKind,
    Verb,
)
from rack.levels.tables import Positive, Table

MAX_GAP_RAD = 0.005
"""Two paths join if no joint is farther than this from the end of one at the start of the next."""
MAX_PLANS = 2 * WINDOW_MOVES
"""Maximum number of stored plans. The planner is never farther ahead than its window, and plans of
done moves are dropped with the next plan."""


class ElementalMoveParams(Table):
    """`[board.<name>.params]`: patience, grasping, and the answers from below."""

    patience: Positive = 60.0
    """time that a move waits for a free path before it is an error [s]"""
    retry: Positive = 2.0
    """time after which a path is searched again although no body has moved [s]"""
    replans: int = Field(10, ge=1, le=1000)
    """number of other paths that one move may try before a blocked path is an error"""
    grasp_gap: Positive | None = None
    """a gripper closer to closed than this holds nothing [m or rad]; default: a twentieth of its
    travel"""
    answer: Positive = 0.3
    """time that settling and the report from below may take [s]"""


class PlanStore:
    """Stores the newest plan of each unfinished move, and the answer to the open request."""

    def __init__(self) -> None:
        self._by_move: dict[int, MovePlan] = {}
        self._answer: MovePlan | None = None

    def store_plan(self, plan: Reading[MovePlan], done: int, handed_down: int, end: Array) -> None:
        """Store a new plan if its move was not handed down and its path joins the previous one.

        A path that does not join was planned from the end of a path that was lost or replaced
        later; it is ignored, and the planner plans the move again. Plans of finished moves are
        dropped. If the new plan is a refusal, or its path ends elsewhere than the move's previous
        path, the plans of all later moves are dropped. An answer to a request for another path is
        always stored.

        Args:
            plan: Newest plan and its verdict.
            done: Id of the newest finished move.
            handed_down: Id of the newest move handed down.
            end: End of the path that precedes the stored ones, (joints,), rad.
        """
        if not plan.is_new:
            return
        message = copy_message(plan.message)
        if message.replan:
            self._answer = message
            return
        for move in [m for m in self._by_move if m < done]:
            del self._by_move[move]
        before = self.find_path_end(message.move - 1)
        if before is None:
            before = end
        if message.move <= handed_down or not (message.error or can_join(message, before)):
            return
        previous = self._by_move.get(message.move)
        stays = (
            previous is not None
            and not (previous.error or message.error)
            and is_close(find_end(previous), find_end(message))
        )
        for move in [m for m in self._by_move if m > message.move and not stays]:
            del self._by_move[move]
        if len(self._by_move) < MAX_PLANS:
            self._by_move[message.move] = message

    def find_plan(self, move: int) -> MovePlan | None:
        """Return the stored plan of a move, which may be a refusal, or None."""
        return self._by_move.get(move)

    def find_answer(self, request: int) -> MovePlan | None:
        """Return the answer to a request for another path, or None if it has not been received."""
        return self._answer if self._answer is not None and self._answer.replan == request else None

    def find_last_planned_move(self, window: Any, handed_down: int) -> int:
        """Return the id of the last move before the first motion without a path.

        Args:
            window: Moves of the level above, an array of `ElementalMove`.
            handed_down: Id of the newest move handed down. It is returned if the next move has no
                path.
        """
        reached = handed_down
        for move in window:
            if move["id"] == reached + 1:
                plan = self._by_move.get(int(move["id"]))
                has_path = plan is not None and plan.error == Error.NONE
                if not has_path and move["verb"] not in (Verb.GRASP, Verb.RELEASE):
                    break
                reached += 1
        return reached

    def find_path_end(self, move: int) -> Array | None:
        """Return the end of the last stored path of the moves up to and including `move`.

        Returns:
            Last waypoint, (joints,), rad, or None if there is no such path.
        """
        paths = [m for m, plan in self._by_move.items() if m <= move and plan.error == Error.NONE]
        return find_end(self._by_move[max(paths)]) if paths else None


def can_join(plan: MovePlan, position: Array) -> bool:
    """Return True if the path of a plan begins close enough to a position.

    Args:
        plan: Plan with a path.
        position: Position of the arm, or end of the preceding path, (joints,), rad.
    """
    return is_close(plan.waypoints[0], position)


def find_end(plan: MovePlan) -> Array:
    """Return the last waypoint of the path of a `MovePlan`, in rad."""
    return np.asarray(plan.waypoints[plan.count - 1])


def is_close(a: Array, b: Array) -> bool:
    """Return True if two configurations agree within the tolerance for joining paths.

    Args:
        a: End of the first path, (joints,), rad.
        b: Start of the second path, (joints,), rad.
    """
    return float(np.abs(a - b).max()) <= MAX_GAP_RAD


class SegmentWindow:
    """The segments that were handed down and are not yet reported done, oldest first.

    The segments are stored in the outgoing `MoveCommand` itself. A serial is never reused: a
    segment that replaces another one gets a new serial.
    """

    def __init__(self, command: MoveCommand) -> None:
        self._command = command
        self._segments = command.segments

    @property
    def count(self) -> int:
        """Number of segments in the window."""
        return self._command.count

    @property
    def first(self) -> Any:
        """The oldest segment. Its fields are zero if the window is empty."""
        return self._segments[0]

    def pop_done(self, done: int) -> Any:
        """Remove and return the oldest segment if its serial is at most `done`. Otherwise None."""
        if not self.count or self._segments["id"][0] > done:
            return None
        segment = self._segments[0].copy()
        self._segments[:-1] = self._segments[1:]
        self._command.count = self.count - 1
        self._clear_unused()
        return segment

    def withdraw_all(self) -> None:
        """Withdraw all segments by emptying the window."""
        self._command.count = 0
        self._clear_unused()

    def add_path(self, move: Any, plan: MovePlan, by_s: float) -> None:
        """Hand down a path.

        Args:
            move: The move, an element of a window of `ElementalMove`.
            plan: Plan that contains the path.
            by_s: Simulated time by which the segment must be done. 0 if it has no deadline.
        """
        segment = self._add_segment(move, SegmentKind.PATH)
        segment["touch"] = move["verb"] in (Verb.APPROACH, Verb.DEPART)
        segment["by"] = by_s
        self._write_path(segment, plan)

    def replace_first(self, plan: MovePlan) -> None:
        """Withdraw all segments, then hand down the oldest move again with another path."""
        self._command.count = 1
        self._clear_unused()
        self._command.id = self.first["id"] = self._command.id + 1
        self._write_path(self.first, plan)

    def add_gripper(self, move: Any, opening: float, force: float) -> None:
        """Hand down a motion of the gripper.

        Args:
            move: The move, an element of a window of `ElementalMove`.
            opening: Opening to reach, m or rad.
            force: Largest force, N or N m.
        """
        segment = self._add_segment(move, SegmentKind.GRIPPER)
        segment["opening"] = opening
        segment["force"] = force

    def find_path_end(self, move: int | None = None) -> Array | None:
        """Return the end of the path of `move`. None selects the newest path in the window.

        Returns:
            Last waypoint, (joints,), rad, or None if there is no such path.
        """
        for segment in self._segments[: self.count][::-1]:
            if segment["kind"] == SegmentKind.PATH and move in (None, segment["move"]):
                return np.array(segment["waypoints"][segment["count"] - 1])
        return None

    def _add_segment(self, move: Any, kind: SegmentKind) -> Any:
        """Append a segment with a new serial, and return it."""
        segment = self._segments[self.count]
        self._command.count = self.count + 1
        self._command.id = segment["id"] = self._command.id + 1
        segment["move"] = move["id"]
        segment["kind"] = kind
        segment["object"] = move["object"]
        return segment

    def _write_path(self, segment: Any, plan: MovePlan) -> None:
        """Write the path of a plan to a segment."""
        segment["count"] = plan.count
        segment["waypoints"] = plan.waypoints
        segment["blend"] = plan.blend

    def _clear_unused(self) -> None:
        """Set unused segments to zero, so that equal windows have equal bytes."""
        self._segments[self.count :] = np.zeros((), self._segments.dtype)
