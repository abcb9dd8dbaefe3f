"""Execution of the requests on the agenda, sample by sample."""

from __future__ import annotations

from typing import Literal, NamedTuple

from pydantic import Field

from rack.levels.algebra import Array
from rack.levels.messages import Error
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.boards import HANDOVER_CYCLES
from rack.levels.systems.trajectory.legs import (
    InfeasibleMotion,
    JointLeg,
    Leg,
    LegTimes,
    ToolGoal,
    ToolLeg,
    WorldView,
)
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest, RequestEnd
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.requests import MOVING_KINDS, Agenda, find_request_error
from rack.levels.tables import Positive, Table


class TrajectoryParams(Table):
    """Times of motions and of following, in `[board.<name>.params]`."""

    acceleration: Positive = 0.3
    """half the time of a blend if a request gives none [s]"""
    gripping: Positive = 0.6
    """time of a GRIP if a request gives none [s]"""
    follow: Positive = 0.25
    """time constant with which a live goal follows its body [s]"""
    blind: Positive = 0.3
    """longest time for which the motion of a body is extrapolated [s]"""
    handover: int = Field(HANDOVER_CYCLES, ge=1, le=1000)
    """cycles after the first set point until statuses must show that it is followed"""
    stalled: Positive = 90.0
    """time for which a request may wait in total until it fails; waits for an operator or for the
    end of a required stop do not count [s]"""
    after_missed: Literal["continue", "hold"] = "continue"
    """what follows a missed deadline of this level; hold: the arm comes to rest, until an operator
    resumes the level or a program cancels its requests"""


class MotionTools(NamedTuple):
    """Models and parameters that are needed to build legs."""

    ik: InverseKinematics
    limits: Limits
    sight: WorldView
    params: TrajectoryParams
    period_s: float


class RequestWork:
    """Begins, blends and ends requests.

    An interrupted motion resumes from the position at which the arm has come to rest.

    Attributes:
        goal: Goal of the current or completed tool leg. None for a leg in joint space.
        passed_s: Time for which the current STAY or GRIP request has run, s.
        grip: Opening, m, and force, N, of the last GRIP.
    """

    def __init__(self, agenda: Agenda, motion: SampledMotion, tools: MotionTools) -> None:
        self.agenda = agenda
        self.motion = motion
        self._tools = tools
        self.goal: ToolGoal | None = None
        self.passed_s = 0.0
        self.grip = 0.0, 0.0
        self._is_interrupted = True  # motion must start again from rest
        self._remaining_fraction = 1.0  # fraction of an interrupted leg's time that remains

    def restore_progress(self, passed_s: float, progress: float) -> None:
        """Continue a request after a restart of the level.

        Args:
            passed_s: Time for which a STAY or GRIP request had run, s.
            progress: Fraction of the request's time that had passed.
        """
        self.passed_s = passed_s
        self._remaining_fraction = 1.0 - progress

    def interrupt_motion(self) -> None:
        """Record that the motion was interrupted, and the fraction of it that remains."""
        if not self._is_interrupted:
            self._remaining_fraction = 1.0 - self.progress
        self._is_interrupted = True
        self.goal = None

    def cancel_motion(self) -> None:
        """Ramp to rest without resuming the motion later."""
        self._remaining_fraction = 1.0
        self._is_interrupted = False
        self.goal = None
        self.motion.ramp_to_rest()

    def end_at_guard(self) -> None:
        """End the current request as GUARDED.

        The arm ramps to rest, and the next request starts from there.
        """
        self.agenda.end_first(RequestEnd.GUARDED)
        self.agenda.goal = None  # the arm has not reached it
        self.cancel_motion()

    def step(self, time_s: float, hold: bool) -> None:
        """Advance to the sample at `time_s`. With `hold`, ramp to rest and begin no request."""
        motion = self.motion
        agenda = self.agenda
        try:
            if self.goal is not None:
                self.goal.update_pose(time_s + self._tools.period_s)
            motion.advance_to(time_s)
        except InfeasibleMotion as error:
            self.fail_request(RequestEnd.FAILED, str(error), Error.LIMIT)
        if hold:
            if motion.leg is not None:
                self.interrupt_motion()
                motion.ramp_to_rest()
            return
        if self._is_interrupted:
            self._resume_motion()
        elif agenda.current is not None and self._is_done(agenda.current):
            agenda.end_first(RequestEnd.DONE)
        if not self._is_interrupted and agenda.next is not None:
            self._begin_when_due(agenda.next)

    @property
    def progress(self) -> float:
        """Fraction of the current request's time that has passed, 0 to 1."""
        current = self.agenda.current
        leg = self.motion.leg
        if current is None:
            return 0.0
        if current.kind not in MOVING_KINDS:
            duration_s = self._compute_duration_s(current)
            return min(self.passed_s / duration_s, 1.0) if duration_s > 0.0 else 1.0
        if leg is None:
            return 1.0 - self._remaining_fraction
        return 1.0 - self._remaining_fraction * (1.0 - min(self.motion.leg_s / leg.law.ends_s, 1.0))

    def fail_request(self, outcome: RequestEnd, reason: str, code: Error) -> None:
        """End the current request with an error and cancel the others.

        Args:
            outcome: REFUSED or FAILED.
            reason: Reason for the user.
            code: Error code for the status.
        """
        self.agenda.fail_first(outcome, code, reason)
        self.goal = None
        self._remaining_fraction = 1.0
        self._is_interrupted = False

    def _resume_motion(self) -> None:
        """Resume an interrupted motion once the arm rests."""
        goal = self.agenda.goal
        current = self.agenda.current
        if not self.motion.is_settled:
            return
        if goal is None or (current is None and not goal.live):
            self._is_interrupted = False
            self._remaining_fraction = 1.0
        elif self._can_begin(goal):
            self._is_interrupted = False
            is_under_way = current is not None and current.id == goal.id
            segment_s = goal.segment * self._remaining_fraction if is_under_way else 0.0
            self._begin_leg(goal, 0.0, segment_s)

    def _is_done(self, current: MotionRequest) -> bool:
        """Return True if the current request is done. Also advances `passed_s`."""
        if not self.motion.is_settled:
            return False
        if current.kind in MOVING_KINDS or current.kind == MotionKind.CANCEL:
            return True
        self.passed_s += self._tools.period_s
        return self.passed_s >= self._compute_duration_s(current)

    def _compute_duration_s(self, request: MotionRequest) -> float:
        """Return the duration, in s, of a request that does not move the arm."""
        if request.kind == MotionKind.GRIP and not request.segment:
            return self._tools.params.gripping
        return request.segment

    def _begin_when_due(self, request: MotionRequest) -> None:
        """Begin a request if it is due.

        It is due when no other request is active, or when the current leg must be blended into it.
        """
        current = self.agenda.current
        leg = self.motion.leg
        if not self._can_begin(request):
            return
        if current is None:
            if self.motion.is_settled:
                self._begin_next_request(0.0)
        elif current.kind in MOVING_KINDS and request.kind in MOVING_KINDS and leg is not None:
            half_s = self._compute_half_blend_s(leg, request)
            if half_s is not None:
                self._begin_next_request(half_s)

    def _compute_half_blend_s(self, leg: Leg, request: MotionRequest) -> float | None:
        """Return half the time in which a leg slows down, if the blend into `request` is due now.

        Returns:
            The time, s. None while it is too early to blend.
        """
        law = leg.law
        passed_s = self.motion.leg_s
        if passed_s > law.ends_s - 2.0 * law.end_blend_half_s:
            # The leg is slowing down already.
            return max(0.5 * (law.ends_s - passed_s), 0.0)
        wanted_s = max(
            request.acceleration or self._tools.params.acceleration, law.min_end_blend_half_s
        )
        half_s = min(wanted_s, law.segment_s - law.half_blend_s)
        law.end_blend_half_s = min(half_s, law.half_blend_s)
        remaining_s = law.nominal_s - passed_s
        return remaining_s if remaining_s < half_s + self._tools.period_s else None

    def _can_begin(self, request: MotionRequest) -> bool:
        """Return True unless the request needs a world model and none has been received."""
        return request.kind not in MOVING_KINDS or request.body < 0 or self._tools.sight.has_model

    def _begin_next_request(self, half_s: float) -> None:
        """Begin the next request, or refuse it if it cannot be executed.

        Args:
            half_s: Half the duration of the blend into the request, s. 0 to start from rest.
        """
        request = self.agenda.begin_next()
        self.passed_s = 0.0
        self._remaining_fraction = 1.0
        if reason := self._find_request_error(request):
            self.fail_request(RequestEnd.REFUSED, reason, Error.UNREACHABLE)
            self.motion.ramp_to_rest()
        elif request.kind in MOVING_KINDS:
            self._begin_leg(request, half_s, request.segment)
        else:
            self._begin_stationary_request(request)

    def _find_request_error(self, request: MotionRequest) -> str:
        """Return why a request cannot be executed, or an empty string if no reason is found."""
        tools = self._tools
        return find_request_error(request, tools.limits.position) or tools.sight.find_body_error(
            request.body
        )

    def _begin_stationary_request(self, request: MotionRequest) -> None:
        """Begin a request that does not move the arm. A GRIP sets the command of the gripper."""
        if request.kind == MotionKind.GRIP:
            self.grip = request.opening, request.force

    def _begin_leg(self, request: MotionRequest, half_s: float, segment_s: float) -> None:
        """Begin the leg to the goal of a request, or refuse the request if no leg is possible.

        Args:
            request: Request of kind JOINTS or POSE.
            half_s: Half the time in which the previous motion slows down, s.
            segment_s: Time of the segment, s. 0 to choose it from the limits.
        """
        tools = self._tools
        half_blend_s = max(request.acceleration or tools.params.acceleration, half_s)
        times = LegTimes(segment_s, half_blend_s)
        goal = None
        if request.kind == MotionKind.POSE:
            goal = ToolGoal(request, tools.sight, tools.params.follow)

        def build_leg(start: Array) -> Leg:
            """Build the leg to the goal from the joint positions `start`."""
            if goal is None:
                return JointLeg(start, request.joints, times, tools.limits)
            goal.update_pose(self.motion.time_s + tools.period_s)
            return ToolLeg(start, goal, times, tools.ik, tools.limits)

        try:
            self.motion.begin_leg(build_leg, half_s)
            self.goal = goal
        except InfeasibleMotion as error:
            self.fail_request(RequestEnd.REFUSED, str(error), Error.UNREACHABLE)
