"""Does the requests of a server of force and motion: those of a trajectory level, COMPLY and
GUARD."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.messages import Error
from rack.levels.systems.force.contact import AXIS_NAMES, UNITS, Contact, Wanted, misfit
from rack.levels.systems.trajectory.boards import JointBoards
from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.requests import Agenda
from rack.levels.systems.trajectory.work import MotionTools, RequestWork, TrajectoryParams
from rack.levels.tables import Positive

LEAST = np.array([5.0] * 3 + [0.5] * 3)
"""N, N m: of a smaller wanted wrench the tolerance is that of these: dry friction and noise do not
scale."""


class ServerParams(TrajectoryParams):
    """`[board.<name>.params]`: how contacts are judged, and what happens without a client."""

    speed: Positive = 0.05
    """most on an axis of force, where a request gives none, m/s"""
    turning: Positive = 0.2
    """the same about an axis, rad/s"""
    tolerance: Positive = Field(0.3, le=1.0)
    """part of a wanted force by which it may be off"""
    settle: Positive = 0.2
    """time for which forces are within it when they are settled, and a COMPLY is done, s"""
    reach: Positive = 4.0
    """longest time without settled forces, s: then compliance ends"""
    silence: Positive = 2.0
    """time without a sign of life after which the client is lost, s"""
    hold: Positive = 3.0
    """time for which forces are held without a client, s"""


class ServerWork(RequestWork):
    """Begins and ends compliance, and judges contacts: see `SERVER_REQUEST`.

    Motion begins anew from where the arm is when axes cease to be of force, or are others: the
    boards below come to rest and hold, and fall into step again.
    """

    boards: JointBoards
    """Those below."""
    most: tuple[float, float]
    """Limits on a contact, N and N m."""

    def __init__(self, agenda: Agenda, motion: SampledMotion, tools: MotionTools) -> None:
        super().__init__(agenda, motion, tools)
        self.contact = Contact()
        # FORCE_STATUS that answers the contact in force; None: none does yet.
        self.force: Message | None = None
        self.guarded = 0  # newest request that a guard has ended
        self.axis = -1  # of that guard
        self._on_s = 0.0  # time for which all forces are as wanted
        self._off_s = 0.0  # time since they were settled

    def step(self, time_s: float, hold: bool) -> None:
        """Go on to the sample at `time_s`; with `hold`, ramp to rest. Judge the contact."""
        super().step(time_s, hold)
        if self.contact.complies:
            self._judge()
        else:
            self._on_s = self._off_s = 0.0

    def strike(self, axis: int) -> None:
        """End the request under way: a guard was struck."""
        current = self.agenda.current
        if current is not None and current.kind != MotionKind.CANCEL:
            self.guarded = current.id
            self.axis = axis
            self.agenda.end(RequestEnd.GUARDED)
        self.contact.unguard()
        self._begin_anew(f"the arm comes to rest: guard of axis {AXIS_NAMES[axis]}")

    def drop(self, how: RequestEnd, reason: str, code: Error) -> None:
        """End all requests with an error; the arm ramps to rest on the axes of motion."""
        self._fail(how, reason, code)
        self.motion.stop()

    def release(self) -> None:
        """End compliance and guards."""
        complied = self.contact.complies
        self.contact.release()
        if complied:
            self._begin_anew("the arm comes to rest: compliance ends")

    def off(self) -> Array:
        """Return by how much forces are off, (6,), as parts of what is tolerated; 0 on axes of
        motion."""
        contact = self.contact
        force = self.force
        if force is None:
            return np.where(contact.selected, np.inf, 0.0)
        # The tool exerts the opposite of what it feels.
        error = np.abs(contact.wrench + force.wrench)
        tolerated = self._params.tolerance * np.maximum(np.abs(contact.wrench), LEAST)
        return np.where(contact.selected, error / tolerated, 0.0)

    @property
    def _params(self) -> ServerParams:
        params = self._tools.params
        assert isinstance(params, ServerParams)
        return params

    def _judge(self) -> None:
        """Count how long forces have been as wanted; end compliance when they have not settled for
        too long."""
        off = self.off()
        current = self.agenda.current
        params = self._params
        period_s = self._tools.period_s
        self._on_s = 0.0 if (off > 1.0).any() else self._on_s + period_s
        self._off_s = 0.0 if self._on_s >= params.settle else self._off_s + period_s
        if current is not None and current.kind == MotionKind.COMPLY:
            self.passed_s = self._on_s
        if self._off_s > params.reach:
            axis = int(off.argmax())
            felt = 0.0 if self.force is None else -self.force.wrench[axis]
            wanted = (
                f"axis {AXIS_NAMES[axis]} has not settled at {self.contact.wrench[axis]:g}"
                f" {UNITS[axis]}"
            )
            self.drop(
                RequestEnd.FAILED, f"{wanted} for {params.reach:g} s: {felt:.3g} now", Error.CONTACT
            )
            self.release()

    def _begin_anew(self, why: str) -> None:
        self.agenda.goal = None  # the arm is not there
        self.boards.leave(why)
        self.interrupt()

    def _misfit(self, request: Message) -> str:
        wanted = Wanted.of(request.record)
        frame = wanted.frame
        if request.kind == MotionKind.COMPLY:
            return misfit(frame, (wanted.wrench,), self.most) if wanted.selected.any() else ""
        if request.kind == MotionKind.GUARD:
            reason = misfit(frame, (wanted.guard,), self.most)
            return reason or self.contact.objection(frame, wanted.guard)
        return super()._misfit(request)

    def _start(self, request: Message) -> None:
        wanted = Wanted.of(request.record)
        if request.kind == MotionKind.GUARD:
            self.contact.watch(wanted.frame, wanted.guard)
        elif request.kind == MotionKind.COMPLY and wanted.selected.any():
            usual = np.array([self._params.speed] * 3 + [self._params.turning] * 3)
            speed = np.where(wanted.speed > 0.0, wanted.speed, usual)
            self._on_s = self._off_s = 0.0
            if self.contact.comply(wanted._replace(speed=speed)):
                self._begin_anew("the arm comes to rest: other axes of force")
        elif request.kind == MotionKind.COMPLY:
            self.release()
        else:
            super()._start(request)

    def _is_done(self, current: Message) -> bool:
        if current.kind != MotionKind.COMPLY:
            return super()._is_done(current)
        return self.motion.settled and (
            not self.contact.complies or self.passed_s >= self._params.settle
        )

    def _lasts_s(self, request: Message) -> float:
        if request.kind == MotionKind.COMPLY and self.contact.complies:
            return self._params.settle
        return super()._lasts_s(request)
