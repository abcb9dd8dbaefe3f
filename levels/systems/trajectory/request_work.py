"""Does the requests of the agenda, sample by sample."""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from rack.levels.algebra import Array
from rack.levels.messages import Error
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.boards import HANDOVER_CYCLES
from rack.levels.systems.trajectory.legs import (
    JointLeg,
    Leg,
    Times,
    ToolGoal,
    ToolLeg,
    Unfit,
    WorldSight,
)
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest, RequestEnd
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.requests import MOTIONS, Agenda, misfit_of
from rack.levels.tables import Positive, Table


class TrajectoryParams(Table):
    """Times of motions and of following, in `[board.<name>.params]`."""

    acceleration: Positive = 0.3
    """half the time of a blend, where a request gives none [s]"""
    gripping: Positive = 0.6
    """time of a GRIP, where a request gives none [s]"""
    follow: Positive = 0.25
    """time constant with which a live goal follows its body [s]"""
    blind: Positive = 0.3
    """time for which a body's motion is extrapolated [s]"""
    handover: int = Field(HANDOVER_CYCLES, ge=1, le=1000)
    """cycles until statuses must show that the first set point is followed"""


class MotionTools(NamedTuple):
    """What makes legs."""

    ik: InverseKinematics
    limits: Limits
    sight: WorldSight
    params: TrajectoryParams
    period_s: float


class RequestWork:
    """Begins, blends and ends requests; interrupted motion goes on from where the arm rests."""

    def __init__(self, agenda: Agenda, motion: SampledMotion, tools: MotionTools) -> None:
        self.agenda = agenda
        self.motion = motion
        self._tools = tools
        # Of the leg under way or reached; None: it is one in joint space.
        self.goal: ToolGoal | None = None
        self.passed_s = 0.0  # time that the request under way has stayed or gripped
        self.grip = 0.0, 0.0  # opening, m, and force, N, wanted by the last GRIP
        self._interrupted = True  # motion must begin anew from rest
        self._left = 1.0  # part of an interrupted leg's time that is left

    def recall(self, passed_s: float, progress: float) -> None:
        """Continue after a restart of the level."""
        self.passed_s = passed_s
        self._left = 1.0 - progress

    def interrupt(self) -> None:
        """Note that the arm was brought to rest elsewhere than at the goal."""
        if not self._interrupted:
            self._left = 1.0 - self.progress
        self._interrupted = True
        self.goal = None

    def cancel(self) -> None:
        """Ramp to rest; no request is under way but a CANCEL."""
        self._left = 1.0
        self._interrupted = False
        self.goal = None
        self.motion.stop()

    def end_guarded(self) -> None:
        """End the request under way, GUARDED: the arm ramps to rest, and goes on from there with
        the next one.
        """
        self.agenda.end(RequestEnd.GUARDED)
        self.agenda.goal = None  # the arm is not there
        self.cancel()

    def step(self, time_s: float, hold: bool) -> None:
        """Go on to the sample at `time_s`; with `hold`, ramp to rest."""
        motion = self.motion
        agenda = self.agenda
        try:
            if self.goal is not None:
                self.goal.update(time_s + self._tools.period_s)
            motion.advance(time_s)
        except Unfit as unfit:
            self._fail(RequestEnd.FAILED, str(unfit), Error.LIMIT)
        if hold:
            if motion.leg is not None:
                self.interrupt()
                motion.stop()
            return
        if self._interrupted:
            self._go_on()
        elif agenda.current is not None and self._is_done(agenda.current):
            agenda.end(RequestEnd.DONE)
        if not self._interrupted and agenda.next is not None:
            self._consider(agenda.next)

    @property
    def progress(self) -> float:
        """Part of the time of the request under way that has passed, 0 to 1."""
        current = self.agenda.current
        leg = self.motion.leg
        if current is None:
            return 0.0
        if current.kind not in MOTIONS:
            lasts = self._lasts_s(current)
            return min(self.passed_s / lasts, 1.0) if lasts > 0.0 else 1.0
        if leg is None:
            return 1.0 - self._left
        return 1.0 - self._left * (1.0 - min(self.motion.leg_s / leg.law.ends_s, 1.0))

    def _fail(self, how: RequestEnd, reason: str, code: Error) -> None:
        self.agenda.fail(how, code, reason)
        self.goal = None
        self._left = 1.0
        self._interrupted = False

    def _go_on(self) -> None:
        """Begin anew the motion that was interrupted, once the arm rests."""
        goal = self.agenda.goal
        current = self.agenda.current
        if not self.motion.settled:
            return
        if goal is None or (current is None and not goal.live):
            self._interrupted = False
            self._left = 1.0
        elif self._can_begin(goal):
            self._interrupted = False
            is_under_way = current is not None and current.id == goal.id
            segment_s = goal.segment * self._left if is_under_way else 0.0
            self._move(goal, 0.0, segment_s)

    def _is_done(self, current: MotionRequest) -> bool:
        if not self.motion.settled:
            return False
        if current.kind in MOTIONS or current.kind == MotionKind.CANCEL:
            return True
        self.passed_s += self._tools.period_s
        return self.passed_s >= self._lasts_s(current)

    def _lasts_s(self, request: MotionRequest) -> float:
        if request.kind == MotionKind.GRIP and not request.segment:
            return self._tools.params.gripping
        return request.segment

    def _consider(self, request: MotionRequest) -> None:
        """Begin `request` if its time has come: nothing is under way, or the leg under way is to be
        blended into it.
        """
        current = self.agenda.current
        leg = self.motion.leg
        if not self._can_begin(request):
            return
        if current is None:
            if self.motion.settled:
                self._begin(0.0)
        elif current.kind in MOTIONS and request.kind in MOTIONS and leg is not None:
            half_s = self._blend_s(leg, request)
            if half_s is not None:
                self._begin(half_s)

    def _blend_s(self, leg: Leg, request: MotionRequest) -> float | None:
        """Return half the time in which `leg` slows down, if now is the time to blend it into
        `request`.
        """
        law = leg.law
        passed_s = self.motion.leg_s
        if passed_s > law.ends_s - 2.0 * law.leaving_s:
            return max(0.5 * (law.ends_s - passed_s), 0.0)  # it slows down already
        wanted_s = max(request.acceleration or self._tools.params.acceleration, law.least_s)
        half_s = min(wanted_s, law.segment_s - law.half_blend_s)
        law.leaving_s = min(half_s, law.half_blend_s)
        left_s = law.nominal_s - passed_s
        return left_s if left_s < half_s + self._tools.period_s else None

    def _can_begin(self, request: MotionRequest) -> bool:
        return request.kind not in MOTIONS or request.body < 0 or self._tools.sight.knows

    def _begin(self, half_s: float) -> None:
        request = self.agenda.begin()
        self.passed_s = 0.0
        self._left = 1.0
        if reason := self._misfit(request):
            self._fail(RequestEnd.REFUSED, reason, Error.UNREACHABLE)
            self.motion.stop()
        elif request.kind in MOTIONS:
            self._move(request, half_s, request.segment)
        else:
            self._start(request)

    def _misfit(self, request: MotionRequest) -> str:
        """Return why a request cannot be done; empty: it may be possible."""
        tools = self._tools
        return misfit_of(request, tools.limits.position) or tools.sight.misfit(request.body)

    def _start(self, request: MotionRequest) -> None:
        """Begin a request that does not move the arm."""
        if request.kind == MotionKind.GRIP:
            self.grip = request.opening, request.force

    def _move(self, request: MotionRequest, half_s: float, segment_s: float) -> None:
        """Begin the leg to the goal of `request`; the motion so far slows down over twice
        `half_s`.
        """
        tools = self._tools
        half_blend_s = max(request.acceleration or tools.params.acceleration, half_s)
        times = Times(segment_s, half_blend_s)
        goal = None
        if request.kind == MotionKind.POSE:
            goal = ToolGoal(request, tools.sight, tools.params.follow)

        def make(start: Array) -> Leg:
            if goal is None:
                return JointLeg(start, request.joints, times, tools.limits)
            goal.update(self.motion.time_s + tools.period_s)
            return ToolLeg(start, goal, times, tools.ik, tools.limits)

        try:
            self.motion.begin(make, half_s)
            self.goal = goal
        except Unfit as unfit:
            self._fail(RequestEnd.REFUSED, str(unfit), Error.UNREACHABLE)
