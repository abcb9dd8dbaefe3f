"""Storage of motion requests in the trajectory level, from their arrival to their end."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from rack.backplane.message import copy_message
from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.systems.trajectory.messages import (
    LISTED_ENDED_REQUESTS,
    MAX_HELD_REQUESTS,
    MotionKind,
    MotionRequest,
    MotionState,
    MotionStatus,
    RequestEnd,
)

MOVING_KINDS = (MotionKind.JOINTS, MotionKind.POSE)
"""Kinds that move the arm, and can be blended into each other."""
VALID_KINDS = range(MotionKind.JOINTS, MotionKind.GRIP + 1)
"""Kinds that every trajectory level can carry out."""


def copy_request(record: Any) -> MotionRequest:
    """Copy the record of a request into a new message."""
    request = MotionRequest(record.dtype)
    request.record[...] = record
    return request


def find_request_error(request: MotionRequest, ranges: Array) -> str:
    """Return the reason why a request is invalid for an arm with these joint ranges.

    Args:
        request: Request to check.
        ranges: Position limits of the joints, (joints, 2), rad.

    Returns:
        The reason, or an empty string if no mistake is found.
    """
    if request.kind not in VALID_KINDS:
        return f"kind {request.kind}; permitted: {VALID_KINDS[0]} to {VALID_KINDS[-1]}"
    times = request.acceleration, request.segment
    if not np.isfinite((*times, request.opening, request.force)).all() or min(times) < 0.0:
        return f"times {times[0]:g} and {times[1]:g} s; permitted: finite, 0 or more"
    quaternion = request.quaternion
    is_pose = np.isfinite((*request.position, *quaternion)).all() and quaternion.any()
    if request.kind == MotionKind.POSE and not is_pose:
        return "the pose is not finite, or its quaternion is zero"
    # The comparison is written so that NaN is refused.
    if not request.touch >= 0.0:
        return f"a guard of {request.touch:g} N m; permitted: 0 or more"
    if request.kind == MotionKind.JOINTS:
        # The comparison is written so that NaN counts as outside.
        is_outside = ~((request.joints >= ranges[:, 0]) & (request.joints <= ranges[:, 1]))
        if is_outside.any():
            joint = int(is_outside.argmax())
            low, high = ranges[joint]
            return (
                f"joint {joint + 1} to {request.joints[joint]:g} rad; permitted: {low:.3f} to"
                f" {high:.3f}"
            )
    return ""


class Agenda:
    """Accepted requests that have not ended, and the outcomes of the last ones that have.

    After an error all requests are dropped, and new ones are refused until a CANCEL. While a
    request of the sequence is missing, later ones are ignored. The sender continues after `taken`,
    or sends a CANCEL.

    Attributes:
        held: Requests that have not ended, oldest first.
        goal: Request whose goal the arm has reached or is moving to. None if there is none.
        taken: Id of the newest request that was taken.
        rests_on: Serial of the newest operator command on which a request depends.
        error: Error that stopped the requests.
        reason: Reason for the error.
    """

    def __init__(self) -> None:
        self.held: list[MotionRequest] = []
        self.has_begun = False  # whether the first of them is under way
        self.goal: MotionRequest | None = None
        self.taken = 0
        self.rests_on = 0
        self.error = Error.NONE
        self.reason = ""
        # Whether the request after `taken` was lost with a board that died while taking it.
        self.is_request_missing = False
        self._ended: deque[tuple[int, RequestEnd]] = deque(maxlen=LISTED_ENDED_REQUESTS)

    @property
    def current(self) -> MotionRequest | None:
        """The request that has begun. None if there is none."""
        return self.held[0] if self.has_begun else None

    @property
    def next(self) -> MotionRequest | None:
        """Request to begin next. None if there is none."""
        index = int(self.has_begun)
        return self.held[index] if len(self.held) > index else None

    @property
    def done(self) -> int:
        """Id of the newest request that has ended, whatever its outcome. 0 if none has."""
        return self._ended[0][0] if self._ended else 0

    @property
    def remaining_capacity(self) -> int:
        """Number of requests that may be taken now."""
        return MAX_HELD_REQUESTS - len(self.held)

    def take_new_requests(self, requests: Reading[MotionRequest]) -> bool:
        """Take new requests. Returns True if the arm must stop because a CANCEL is among them."""
        is_cancelled = False
        if requests.is_new:
            for message in (*requests.earlier, requests.message):
                is_cancelled |= self._take_request(copy_message(message))
        return is_cancelled

    def _take_request(self, request: MotionRequest) -> bool:
        """Accept, refuse or ignore a request. Returns True for a new CANCEL."""
        # A planning level sends a request again after its own restart, or if the status does not
        # show the request. Ignore the repetition.
        if request.id <= self.taken:
            return False
        if request.kind != MotionKind.CANCEL and self.taken and request.id != self.taken + 1:
            self.is_request_missing = True
            return False
        self.is_request_missing = False
        self.taken = request.id
        self.rests_on = max(self.rests_on, request.operator)
        if request.kind == MotionKind.CANCEL:
            self._cancel_all()
            self.error = Error.NONE
            self.reason = ""
            self.held = [request]
            self.has_begun = True
            self.goal = None
            return True
        if self.error:
            self._record_end(request, RequestEnd.REFUSED)
        else:
            self.held.append(request)
        return False

    def begin_next(self) -> MotionRequest:
        """Begin the next request and return it. The current request, if any, ends DONE."""
        if self.has_begun:
            self.end_first(RequestEnd.DONE)
        self.has_begun = True
        request = self.held[0]
        if request.kind in MOVING_KINDS:
            self.goal = request
        return request

    def end_first(self, outcome: RequestEnd) -> None:
        """End the oldest request with the given outcome."""
        self._record_end(self.held.pop(0), outcome)
        self.has_begun = False

    def fail_first(self, outcome: RequestEnd, code: Error, reason: str) -> None:
        """Fail the oldest request, cancel the others, and refuse new ones until a CANCEL.

        Args:
            outcome: REFUSED or FAILED.
            code: Error code for the status.
            reason: Reason for the user.
        """
        self.error = code
        self.reason = reason
        self.goal = None
        if self.held:
            self.reason = f"request {self.held[0].id}: {reason}"
            self.end_first(outcome)
        self._cancel_all()

    def _cancel_all(self) -> None:
        """End all requests as CANCELLED."""
        for request in self.held:
            self._record_end(request, RequestEnd.CANCELLED)
        self.held = []
        self.has_begun = False

    def _record_end(self, request: MotionRequest, outcome: RequestEnd) -> None:
        """Record how a request ended."""
        self._ended.appendleft((request.id, outcome))

    def fill_status(self, status: MotionStatus) -> None:
        """Fill the ids and outcomes of a `MotionStatus`."""
        current = self.current
        status.taken = self.taken
        status.current = current.id if current is not None else 0
        status.done = self.done
        for k, ended in enumerate(self._ended):
            status.ended[k], status.ends[k] = ended

    def fill_state(self, state: MotionState) -> None:
        """Fill the open requests and the goal of a `MotionState`."""
        state.begun = self.has_begun
        state.count = len(self.held)
        for k, request in enumerate(self.held):
            state.requests[k] = request.record
        if self.goal is not None:
            state.goal[...] = self.goal.record
        else:
            state.goal["id"] = 0

    def restore_requests(self, state: MotionState, status: MotionStatus) -> None:
        """Continue from the last messages of a level that was restarted."""
        self.held = [copy_request(record) for record in state.requests[: state.count]]
        self.has_begun = state.begun
        self.goal = copy_request(state.goal) if state.goal["id"] else None
        self.taken = status.taken
        self.rests_on = status.operator
        self.error = Error(status.error)
        self.reason = status.reason if status.error else ""
        ends = zip(status.ended.tolist(), status.ends.tolist(), strict=True)
        self._ended.extend((request, RequestEnd(outcome)) for request, outcome in ends if request)
