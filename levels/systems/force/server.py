"""The executor of a force and motion server.

It carries out the requests of a client: motions, as a trajectory level does, COMPLY and GUARD. When
the client is lost, it brings the arm to a safe state.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array
from rack.levels.level import Input, LevelContext, Output
from rack.levels.messages import Error
from rack.levels.systems.force.contact import (
    AXIS_NAMES,
    UNITS,
    Contact,
    WantedContact,
    WristLevel,
    check_frame_and_wrenches,
)
from rack.levels.systems.force.messages import (
    AXES,
    Compliance,
    ForceStatus,
    Mode,
    ServerRequest,
    ServerState,
    ServerStatus,
)
from rack.levels.systems.trajectory import TrajectoryExecutor
from rack.levels.systems.trajectory.boards import JointBoards
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest, RequestEnd
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.request_work import MotionTools, RequestWork, TrajectoryParams
from rack.levels.systems.trajectory.requests import Agenda
from rack.levels.tables import Positive

MIN_TOLERATED_WRENCH = np.array([5.0] * 3 + [0.5] * 3)
"""Wrench, N, N m, whose tolerance also applies to smaller wrenches, because dry friction and noise
do not scale with the wrench."""


class ServerParams(TrajectoryParams):
    """`[board.<name>.params]`: how contacts are judged, and the reaction to a lost client."""

    speed: Positive = 0.05
    """largest velocity on an axis of force if a request gives none [m/s]"""
    turning: Positive = 0.2
    """largest velocity about an axis of force if a request gives none [rad/s]"""
    tolerance: Positive = Field(0.3, le=1.0)
    """permitted error of a force, as a part of the wanted one"""
    settle: Positive = 0.2
    """time within the tolerance after which forces are settled and a COMPLY is done [s]"""
    reach: Positive = 4.0
    """time without settled forces after which compliance ends [s]"""
    silence: Positive = 2.0
    """time without a sign of life after which the client is lost [s]"""
    hold: Positive = 3.0
    """time for which forces are held without a client [s]"""


class ServerWork(RequestWork):
    """Carries out requests, including COMPLY and GUARD, and checks contacts.

    See `ServerRequest`. When the set of force axes changes, motion restarts from the position of
    the arm: the boards below come to rest, hold, and then follow set points again.
    """

    boards: JointBoards
    """The boards below."""
    most: tuple[float, float]
    """Limits on a contact, N and N m."""

    def __init__(self, agenda: Agenda, motion: SampledMotion, tools: MotionTools) -> None:
        super().__init__(agenda, motion, tools)
        self.contact = Contact.zeros({})
        self.contact.frame[0] = 1.0
        # Status that answers the contact in force, or None before there is one.
        self.force: ForceStatus | None = None
        self.guarded = 0  # id of the newest request that a guard has ended
        self.axis = -1  # axis of that guard
        self._on_s = 0.0  # time for which all forces have been as wanted
        self._off_s = 0.0  # time since forces were settled

    def step(self, time_s: float, hold: bool) -> None:
        """Advance the motion to a sample, and check the contact.

        Args:
            time_s: Time of the sample.
            hold: True if the motion must ramp to rest.
        """
        super().step(time_s, hold)
        if self.contact.is_compliant:
            self._check_forces()
        else:
            self._on_s = self._off_s = 0.0

    def strike_guard(self, axis: int) -> None:
        """End the request under way, because the guard of `axis` was struck. Remove all guards."""
        current = self.agenda.current
        if current is not None and current.kind != MotionKind.CANCEL:
            self.guarded = current.id
            self.axis = axis
            self.agenda.end_first(RequestEnd.GUARDED)
        self.contact.set_guards(self.contact.frame, np.zeros(AXES))
        self._restart_motion(f"the arm comes to rest: guard of axis {AXIS_NAMES[axis]}")

    def drop_requests(self, how: RequestEnd, reason: str, code: Error) -> None:
        """End all requests with an error. The arm ramps to rest on the axes of motion.

        Args:
            how: Outcome to report for the requests.
            reason: Reason to report.
            code: Error code to report.
        """
        self.fail_request(how, reason, code)
        self.motion.ramp_to_rest()

    def end_compliance(self) -> None:
        """End compliance, remove all guards, and restart the motion if there was compliance."""
        complied = self.contact.is_compliant
        self.contact.release_axes()
        if complied:
            self._restart_motion("the arm comes to rest: compliance ends")

    def compute_force_errors(self) -> Array:
        """Return the force errors as multiples of the tolerance, (6,), 0 on axes of motion."""
        contact = self.contact
        force = self.force
        if force is None:
            return np.where(contact.selected, np.inf, 0.0)
        # The tool exerts the opposite of the wrench that acts on it.
        error = np.abs(contact.wrench + force.wrench)
        tolerated = self._params.tolerance * np.maximum(
            np.abs(contact.wrench), MIN_TOLERATED_WRENCH
        )
        return np.where(contact.selected, error / tolerated, 0.0)

    @property
    def _params(self) -> ServerParams:
        """Parameters of the board."""
        params = self._tools.params
        assert isinstance(params, ServerParams)
        return params

    def _check_forces(self) -> None:
        """Update how long the forces have been within tolerance, and how long not settled.

        If the forces do not settle within `reach`, end the requests and compliance.
        """
        errors = self.compute_force_errors()
        current = self.agenda.current
        params = self._params
        period_s = self._tools.period_s
        self._on_s = 0.0 if (errors > 1.0).any() else self._on_s + period_s
        self._off_s = 0.0 if self._on_s >= params.settle else self._off_s + period_s
        if current is not None and current.kind == MotionKind.COMPLY:
            self.passed_s = self._on_s
        if self._off_s > params.reach:
            axis = int(errors.argmax())
            felt = 0.0 if self.force is None else -self.force.wrench[axis]
            wanted = (
                f"axis {AXIS_NAMES[axis]} has not settled at {self.contact.wrench[axis]:g}"
                f" {UNITS[axis]}"
            )
            self.drop_requests(
                RequestEnd.FAILED, f"{wanted} for {params.reach:g} s: {felt:.3g} now", Error.CONTACT
            )
            self.end_compliance()

    def _restart_motion(self, reason: str) -> None:
        """Restart the motion from where the boards below come to rest. `reason` is reported."""
        self.agenda.goal = None  # the arm is not at the goal of a request
        self.boards.leave_step(reason)
        self.interrupt_motion()

    def _find_request_error(self, request: MotionRequest) -> str:
        """Return the reason why a request is invalid, or an empty string if it is valid."""
        wanted = WantedContact.from_record(request.record)
        frame = wanted.frame
        if request.kind == MotionKind.COMPLY:
            return (
                check_frame_and_wrenches(frame, (wanted.wrench,), self.most)
                if wanted.selected.any()
                else ""
            )
        if request.kind == MotionKind.GUARD:
            reason = check_frame_and_wrenches(frame, (wanted.guard,), self.most)
            return reason or self.contact.find_guard_error(frame, wanted.guard)
        return super()._find_request_error(request)

    def _begin_stationary_request(self, request: MotionRequest) -> None:
        """Start a request with the arm at rest: set guards or axes of force, or begin a motion."""
        wanted = WantedContact.from_record(request.record)
        if request.kind == MotionKind.GUARD:
            self.contact.set_guards(wanted.frame, wanted.guard)
        elif request.kind == MotionKind.COMPLY and wanted.selected.any():
            default_speed = np.array([self._params.speed] * 3 + [self._params.turning] * 3)
            speed = np.where(wanted.speed > 0.0, wanted.speed, default_speed)
            self._on_s = self._off_s = 0.0
            if self.contact.set_force_axes(wanted._replace(speed=speed)):
                self._restart_motion("the arm comes to rest: other axes of force")
        elif request.kind == MotionKind.COMPLY:
            self.end_compliance()
        else:
            super()._begin_stationary_request(request)

    def _is_done(self, current: MotionRequest) -> bool:
        """Return True if the current request is done. COMPLY requires settled forces and rest."""
        if current.kind != MotionKind.COMPLY:
            return super()._is_done(current)
        return self.motion.is_settled and (
            not self.contact.is_compliant or self.passed_s >= self._params.settle
        )

    def _compute_duration_s(self, request: MotionRequest) -> float:
        """Return the expected duration of a request, in s."""
        if request.kind == MotionKind.COMPLY and self.contact.is_compliant:
            return self._params.settle
        return super()._compute_duration_s(request)


class ForceServer(WristLevel, TrajectoryExecutor):
    """A trajectory level above hybrid control, which can turn axes into axes of force.

    A client counts as lost if it falls silent while requests are pending or some axes are axes of
    force. Its requests are CANCELLED, and the arm comes to rest on the axes of motion. Forces are
    held for `hold`, then reduced to zero, and the arm holds its position. Requests are REFUSED
    until a CANCEL.
    """

    requests = Input(ServerRequest, "above.requests")
    force = Input(ForceStatus, "below.force")
    last_status = Input(ServerStatus, "own.status")
    last_state = Input(ServerState, "own.state")
    last_compliance = Input(Compliance, "own.compliance")
    status = Output(ServerStatus, rests_on=TrajectoryExecutor.boards)
    state = Output(ServerState)
    compliance = Output(Compliance)
    params = ServerParams
    settings: ServerParams
    work_class = ServerWork
    _work: ServerWork

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._work.boards = self._boards
        wrist = context.robot.wrist
        assert wrist is not None, "`find_mismatches` refuses an arm without a sensor"
        self._work.most = wrist.most_force, wrist.most_torque
        self._now = 0  # tick of this cycle
        self._heard = -1  # tick of the client's last sign of life, or -1 before the first cycle
        self._without = Mode.MOTION  # mode without a client
        self._since = 0  # tick at which that mode began
        self._sensed = np.array(context.robot.home)  # (joints,), rad

    def process(self, tick: int) -> None:
        """Run one cycle: take requests, check client and contact, continue the motion."""
        self._now = tick
        if self._heard < 0 or self.requests.is_new:
            self._heard = tick
        super().process(tick)
        contact = self._work.contact
        contact.active = contact.is_compliant or bool(contact.guard.any())
        self.compliance.copy_from(contact)
        self.compliance.operator = self.command.operator
        self._write_server_status(self.status)

    @property
    def mode(self) -> Mode:
        """Present mode of the server."""
        if self._agenda.error is Error.CLIENT:
            return self._without
        return Mode.FORCE if self._work.contact.is_compliant else Mode.MOTION

    def _restore_state(self) -> None:
        """Continue from the last messages after a restart, including the contact."""
        super()._restore_state()
        if self.last_compliance.has_message and self.last_status.has_message:
            self._work.contact.copy_from(self.last_compliance.message)
            status = self.last_status.message
            self._work.guarded = status.guarded
            self._work.axis = status.axis
            self._without = status.mode
            self._since = self._now

    def _follow_boards(self) -> None:
        """Process the statuses of the boards below and of the contact, and watch the client."""
        super()._follow_boards()
        for below in self.boards.values():
            if below.has_message:
                self._sensed = below.message.position
        # Use the force status that answers the present contact. A struck guard ends the request.
        status = self.force.message
        work = self._work
        answers = (
            self.force.has_message
            and not self.force.is_lost
            and status.echo == work.contact.id
            and status.sensed >= 0
        )
        work.force = status if answers else None
        if answers and status.struck == work.contact.id and work.contact.guard.any():
            work.strike_guard(status.axis)
        self._watch_client()

    def _watch_client(self) -> None:
        """React to the loss of the client: hold forces, release them, then hold the position."""
        work = self._work
        params = self.settings
        agenda = self._agenda
        if agenda.error is not Error.CLIENT:
            if self._compute_passed_s(self._heard) > params.silence and (
                agenda.held or work.contact.is_compliant
            ):
                work.drop_requests(RequestEnd.CANCELLED, "", Error.CLIENT)
                if work.contact.is_compliant:
                    self._enter_mode(Mode.HELD, f"forces are held for {params.hold:g} s")
                else:
                    self._enter_mode(Mode.RELEASED, "the position is held")
        elif self._without is Mode.HELD and self._compute_passed_s(self._since) > params.hold:
            work.contact.clear_wrench()
            self._enter_mode(Mode.RELEASING, "forces go to zero")
        elif self._without is Mode.RELEASING:
            is_over = self._compute_passed_s(self._since) > params.reach
            if is_over or (work.compute_force_errors() <= 1.0).all():
                work.end_compliance()
                self._enter_mode(Mode.RELEASED, "forces released, the position is held")

    def _enter_mode(self, mode: Mode, description: str) -> None:
        """Enter a mode without service. The reason in the status contains `description`."""
        self._without = mode
        self._since = self._now
        silent = f"no sign of life from the client for {self.settings.silence:g} s"
        self._agenda.reason = f"{silent}: {description}; cancel, then go on"

    def _compute_passed_s(self, tick: int) -> float:
        """Return the time since `tick`, in s."""
        return (self._now - tick) * self.context.tick_s

    def _write_server_status(self, status: ServerStatus) -> None:
        """Fill those fields of the status that only a force and motion server has."""
        work = self._work
        force = work.force
        status.mode = self.mode
        (status.place, status.quaternion) = self._ik.compute_tool_pose(self._sensed)
        status.frame = work.contact.frame
        status.selected = work.contact.selected
        status.wanted = work.contact.wrench
        if force is not None:
            status.wrench = -force.wrench
        status.guarded = work.guarded
        status.axis = work.axis
