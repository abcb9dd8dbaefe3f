"""Motion requests as the trajectory level keeps them, from taking to end."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.planning.pose import Pose, pose
from rack.levels.systems.trajectory.messages import ENDED, HELD, MotionKind, RequestEnd

MOTIONS = (MotionKind.JOINTS, MotionKind.POSE)
"""Kinds that may be blended into each other."""
KINDS = range(MotionKind.JOINTS, MotionKind.GRIP + 1)
"""Kinds that any trajectory level can do."""
NUMBERS = (
    "id",
    "kind",
    "body",
    "acceleration",
    "segment",
    "opening",
    "force",
    "touch",
    "operator",
)
"""Fields of a request that are one number each."""


class MotionRequest(NamedTuple):
    """A copy of one `MOTION_REQUEST`; see there for units."""

    id: int
    kind: int
    joints: Array
    goal: Pose
    body: int
    live: bool
    acceleration: float
    segment: float
    opening: float
    force: float
    touch: float
    operator: int
    record: np.ndarray  # the whole

    @classmethod
    def of(cls, record: np.ndarray) -> MotionRequest:
        """Return a copy of a request's record."""
        own = record.copy()
        goal = pose(own["position"], own["quaternion"])
        numbers = {name: own[name].item() for name in NUMBERS}
        return cls(joints=own["joints"], goal=goal, live=bool(own["live"]), record=own, **numbers)

    @property
    def moves(self) -> bool:
        """Whether it moves the arm."""
        return self.kind in MOTIONS

    @property
    def is_guarded(self) -> bool:
        """Whether a touch ends it."""
        return self.kind == MotionKind.POSE and self.touch != 0.0

    def misfit(self, ranges: Array) -> str:
        """Return why no arm could do it; empty: it may be possible. `ranges` (joints, 2), rad."""
        if self.kind not in KINDS:
            return f"kind {self.kind}; permitted: {KINDS[0]} to {KINDS[-1]}"
        numbers = (self.acceleration, self.segment, self.opening, self.force)
        if not np.isfinite(numbers).all() or self.acceleration < 0.0 or self.segment < 0.0:
            return (
                f"times {self.acceleration:g} and {self.segment:g} s; permitted: finite, 0 or more"
            )
        turn = self.record["quaternion"]
        is_pose = np.isfinite((*self.record["position"], *turn)).all() and turn.any()
        if self.kind == MotionKind.POSE and not is_pose:
            return "the pose is not finite, or its quaternion is zero"
        # Written so that NaN is one.
        if not self.touch >= 0.0:
            return f"a guard of {self.touch:g} N m; permitted: 0 or more"
        if self.kind == MotionKind.JOINTS:
            # Written so that NaN is outside.
            outside = ~((self.joints >= ranges[:, 0]) & (self.joints <= ranges[:, 1]))
            if outside.any():
                joint = int(outside.argmax())
                low, high = ranges[joint]
                return (
                    f"joint {joint + 1} to {self.joints[joint]:g} rad; permitted: {low:.3f} to"
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

    def take(self, requests: Reading) -> bool:
        """Take what is new; return whether the arm must stop: a CANCEL came."""
        cancelled = False
        if requests.is_new:
            for message in (*requests.earlier, requests.value):
                cancelled |= self._take(MotionRequest.of(message.record))
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
        if request.moves:
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

    def report(self, status: Message) -> None:
        """Fill the ids, the ends and the error of a `MOTION_STATUS`."""
        current = self.current
        status.taken = self.taken
        status.current = current.id if current is not None else 0
        status.done = self.done
        for k, ended in enumerate(self._ended):
            status.ended[k], status.ends[k] = ended

    def save(self, state: Message) -> None:
        """Fill a `MOTION_STATE`."""
        state.begun = self.begun
        state.count = len(self.held)
        for k, request in enumerate(self.held):
            state.requests[k] = request.record
        if self.goal is not None:
            state.goal[...] = self.goal.record
        else:
            state.goal["id"] = 0

    def recall(self, state: Message, status: Message) -> None:
        """Continue from the last messages of a level that was restarted."""
        self.held = [MotionRequest.of(record) for record in state.requests[: state.count]]
        self.begun = bool(state.begun)
        self.goal = MotionRequest.of(state.goal) if state.goal["id"] else None
        self.taken = status.taken
        self.rests_on = status.operator
        self.error = Error(status.error)
        self.reason = status.reason if status.error else ""
        ends = zip(status.ended.tolist(), status.ends.tolist(), strict=True)
        self._ended.extend((request, RequestEnd(how)) for request, how in ends if request)
