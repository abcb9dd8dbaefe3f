"""Motion requests as the trajectory level keeps them, from taking to end."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from rack.backplane.message import copied
from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.systems.trajectory.messages import (
    ENDED,
    HELD,
    MotionKind,
    MotionRequest,
    MotionState,
    MotionStatus,
    RequestEnd,
)

MOTIONS = (MotionKind.JOINTS, MotionKind.POSE)
"""Kinds that may be blended into each other."""
KINDS = range(MotionKind.JOINTS, MotionKind.GRIP + 1)
"""Kinds that any trajectory level can do."""


def copy_request(record: Any) -> MotionRequest:
    """Return a copy of the record of a request."""
    request = MotionRequest(record.dtype)
    request.record[...] = record
    return request


def misfit_of(request: MotionRequest, ranges: Array) -> str:
    """Return why no arm whose joints have `ranges`, (joints, 2), rad, could do a request; empty: it
    may be possible.
    """
    if request.kind not in KINDS:
        return f"kind {request.kind}; permitted: {KINDS[0]} to {KINDS[-1]}"
    times = request.acceleration, request.segment
    if not np.isfinite((*times, request.opening, request.force)).all() or min(times) < 0.0:
        return f"times {times[0]:g} and {times[1]:g} s; permitted: finite, 0 or more"
    turn = request.quaternion
    is_pose = np.isfinite((*request.position, *turn)).all() and turn.any()
    if request.kind == MotionKind.POSE and not is_pose:
        return "the pose is not finite, or its quaternion is zero"
    # Written so that NaN is one.
    if not request.touch >= 0.0:
        return f"a guard of {request.touch:g} N m; permitted: 0 or more"
    if request.kind == MotionKind.JOINTS:
        # Written so that NaN is outside.
        outside = ~((request.joints >= ranges[:, 0]) & (request.joints <= ranges[:, 1]))
        if outside.any():
            joint = int(outside.argmax())
            low, high = ranges[joint]
            return (
                f"joint {joint + 1} to {request.joints[joint]:g} rad; permitted: {low:.3f} to"
                f" {high:.3f}"
            )
    return ""


class Agenda:
    """Requests taken and not ended, oldest first, and how the last ones ended.

    After an error all are dropped, and those that come are refused until a CANCEL. While one is
    missing, those after it are left: the sender sees by `taken` where to begin again, or sends a
    CANCEL.
    """

    def __init__(self) -> None:
        self.held: list[MotionRequest] = []
        self.begun = False  # the first of them is under way
        self.goal: MotionRequest | None = None  # at whose goal the arm is, or to which it goes
        self.taken = 0  # newest id taken
        self.rests_on = 0  # newest command of an operator on which a request taken rests
        self.error = Error.NONE
        self.reason = ""
        # The request after `taken` was lost, with a board that died as it took it.
        self.missing = False
        self._ended: deque[tuple[int, RequestEnd]] = deque(maxlen=ENDED)

    @property
    def current(self) -> MotionRequest | None:
        """The request under way."""
        return self.held[0] if self.begun else None

    @property
    def next(self) -> MotionRequest | None:
        """The request after that, or the first one."""
        at = int(self.begun)
        return self.held[at] if len(self.held) > at else None

    @property
    def done(self) -> int:
        """Newest request ended, however; 0: none yet."""
        return self._ended[0][0] if self._ended else 0

    @property
    def room(self) -> int:
        """Requests that may be taken now."""
        return HELD - len(self.held)

    def take(self, requests: Reading[MotionRequest]) -> bool:
        """Take what is new; return whether the arm must stop: a CANCEL came."""
        cancelled = False
        if requests.is_new:
            for message in (*requests.earlier, requests.message):
                cancelled |= self._take(copied(message))
        return cancelled

    def _take(self, request: MotionRequest) -> bool:
        # One sent again, by a planning level that was restarted or that misses it in the status, is
        # not a new one.
        if request.id <= self.taken:
            return False
        if request.kind != MotionKind.CANCEL and self.taken and request.id != self.taken + 1:
            self.missing = True
            return False
        self.missing = False
        self.taken = request.id
        self.rests_on = max(self.rests_on, request.operator)
        if request.kind == MotionKind.CANCEL:
            self._drop_all()
            self.error = Error.NONE
            self.reason = ""
            self.held = [request]
            self.begun = True
            self.goal = None
            return True
        if self.error:
            self._end(request, RequestEnd.REFUSED)
        else:
            self.held.append(request)
        return False

    def begin(self) -> MotionRequest:
        """Begin the next request; the one under way is done."""
        if self.begun:
            self.end(RequestEnd.DONE)
        self.begun = True
        request = self.held[0]
        if request.kind in MOTIONS:
            self.goal = request
        return request

    def end(self, how: RequestEnd) -> None:
        """End the first request."""
        self._end(self.held.pop(0), how)
        self.begun = False

    def fail(self, how: RequestEnd, code: Error, reason: str) -> None:
        """End the first request so, drop the others, refuse those that come."""
        self.error = code
        self.reason = reason
        self.goal = None
        if self.held:
            self.reason = f"request {self.held[0].id}: {reason}"
            self.end(how)
        self._drop_all()

    def _drop_all(self) -> None:
        for request in self.held:
            self._end(request, RequestEnd.CANCELLED)
        self.held = []
        self.begun = False

    def _end(self, request: MotionRequest, how: RequestEnd) -> None:
        self._ended.appendleft((request.id, how))

    def report(self, status: MotionStatus) -> None:
        """Fill the ids, the ends and the error of a `MotionStatus`."""
        current = self.current
        status.taken = self.taken
        status.current = current.id if current is not None else 0
        status.done = self.done
        for k, ended in enumerate(self._ended):
            status.ended[k], status.ends[k] = ended

    def save(self, state: MotionState) -> None:
        """Fill a `MotionState`."""
        state.begun = self.begun
        state.count = len(self.held)
        for k, request in enumerate(self.held):
            state.requests[k] = request.record
        if self.goal is not None:
            state.goal[...] = self.goal.record
        else:
            state.goal["id"] = 0

    def recall(self, state: MotionState, status: MotionStatus) -> None:
        """Continue from the last messages of a level that was restarted."""
        self.held = [copy_request(record) for record in state.requests[: state.count]]
        self.begun = state.begun
        self.goal = copy_request(state.goal) if state.goal["id"] else None
        self.taken = status.taken
        self.rests_on = status.operator
        self.error = Error(status.error)
        self.reason = status.reason if status.error else ""
        ends = zip(status.ended.tolist(), status.ends.tolist(), strict=True)
        self._ended.extend((request, RequestEnd(how)) for request, how in ends if request)
