"""The window of segments that the elemental move level hands down, kept in the outgoing command itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.messages import SEGMENTS, SegmentKind, Verb


class SegmentWindow:
    """Segments handed down and not known to be done, oldest first, in a `MOVE_COMMAND`.

    A serial is given once only: a segment that replaces another has a newer one.
    """

    def __init__(self, command: Message) -> None:
        self._command = command
        self._segments = command.segments

    @property
    def count(self) -> int:
        """Segments in the window."""
        return int(self._command.count)

    @property
    def is_full(self) -> bool:
        """True when no segment may be added."""
        return self.count >= SEGMENTS

    @property
    def first(self) -> Any:
        """The oldest segment; valid while `count` is not 0."""
        return self._segments[0]

    @property
    def newest_move(self) -> int:
        """The move of the newest segment; 0 in an empty window."""
        return int(self._segments["move"][self.count - 1]) if self.count else 0

    def take_done(self, done: int) -> Any:
        """Take out and return the oldest segment if its serial is at most `done`; else return None."""
        if not self.count or self._segments["id"][0] > done:
            return None
        taken = self._segments[0].copy()
        self._segments[:-1] = self._segments[1:]
        self._command.count = self.count - 1
        self._blank()
        return taken

    def clear(self) -> None:
        """Withdraw every segment."""
        self._command.count = 0
        self._blank()

    def add_path(self, move: Any, plan: Message, by_s: float) -> None:
        """Hand down the path of `plan` for `move`, an element of a window of `ELEMENTAL_MOVE`."""
        segment = self._add(move, SegmentKind.PATH)
        segment["touch"] = move["verb"] in (Verb.APPROACH, Verb.DEPART)
        segment["by"] = by_s
        self._lay(segment, plan)

    def replace_first(self, plan: Message) -> None:
        """Withdraw all and hand the oldest segment down again along another path, with a serial of its own."""
        self._command.count = 1
        self._blank()
        self._command.id = self.first["id"] = int(self._command.id) + 1
        self._lay(self.first, plan)

    def add_gripper(self, move: Any, opening: float, force: float) -> None:
        """Hand down a motion of the gripper to `opening`, m or rad, with at most `force`, N or N m."""
        segment = self._add(move, SegmentKind.GRIPPER)
        segment["opening"], segment["force"] = opening, force

    def end(self) -> NDArray[np.float64] | None:
        """Return the last waypoint (joints,) of the newest path in the window; None: there is none."""
        for segment in self._segments[: self.count][::-1]:
            if segment["kind"] == SegmentKind.PATH:
                return np.array(segment["waypoints"][segment["count"] - 1])
        return None

    def _add(self, move: Any, kind: SegmentKind) -> Any:
        segment = self._segments[self.count]
        self._command.count = self.count + 1
        self._command.id = segment["id"] = int(self._command.id) + 1
        segment["move"], segment["kind"], segment["object"] = move["id"], kind, move["object"]
        return segment

    def _lay(self, segment: Any, plan: Message) -> None:
        segment["count"] = plan.count
        segment["waypoints"], segment["blend"] = plan.waypoints, plan.blend

    def _blank(self) -> None:
        """Zero what is not in the window, so that equal windows have equal bytes."""
        self._segments[self.count :] = np.zeros((), self._segments.dtype)
