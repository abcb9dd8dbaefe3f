"""Coordinated motion of two arms, each of which has its own rack, planner and queue of requests.

A request MEET begins when the arm rests at the goal before it. It ends on both arms at the same
instant, `meeting_s` after the later of both has arrived. The first sample of the next motion is
therefore the same on both, although each plans and queues its requests on its own, as the
trajectory generator of Multi-RCCL coordinated several robots [S4]; how it did so is assumed.

Each level sends the other the number of its meetings and the time of the last arrival. Both compute
the start from the same two times, so a delay of messages below `meeting_s` has no effect. An arm
that learns of the other's arrival later begins at once, and reports by how much it is late.
"""

from __future__ import annotations

import math
from typing import ClassVar

from rack.backplane.message import Message, field, integer_field
from rack.levels.level import Input, LevelContext, Output
from rack.levels.peer import PeerPresence
from rack.levels.systems.trajectory.executor import TrajectoryExecutor
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.request_work import MotionTools, RequestWork, TrajectoryParams
from rack.levels.systems.trajectory.requests import Agenda
from rack.levels.tables import Positive

ROUNDING_S = 1e-6
"""Tolerance for the times of two racks, which are sums of ticks."""


class Meeting(Message, version=1):
    """Meetings of an arm with another one. Times are in simulated time of the sending rack."""

    number: int = integer_field("meetings at which this arm has arrived")
    request: int = integer_field("id of the request of the last one (0: none)")
    arrived: float = field(unit="s", doc="time of the sample in which it arrived at the last one")
    begun: int = integer_field("meetings that have ended, with a common start")
    start: float = field(unit="s", doc="time of the first sample after the last common start")
    late: float = field(unit="s", doc="how much later than agreed this arm began (0: on time)")


class MeetingParams(TrajectoryParams):
    """`[board.<name>.params]` of a trajectory level that meets another arm."""

    meeting_s: Positive = 0.1
    """time from the arrival of the later arm to the start, longer than messages take [s]"""


class MeetingWork(RequestWork):
    """Carries out requests, including MEET.

    Attributes:
        meeting: Message to the other arm, filled here.
        partner_number: Meetings at which the other arm has arrived.
        partner_arrived_s: Time of its last arrival, in simulated time of this rack.
    """

    meeting: Meeting

    def __init__(self, agenda: Agenda, motion: SampledMotion, tools: MotionTools) -> None:
        super().__init__(agenda, motion, tools)
        assert isinstance(tools.params, MeetingParams)
        self._meeting_s = tools.params.meeting_s
        self._time_s = 0.0  # of the present sample
        self.partner_number = 0
        self.partner_arrived_s = 0.0

    @property
    def start_s(self) -> float:
        """Agreed time of the common start, s. Infinite until the other arm has arrived."""
        meeting = self.meeting
        if self.partner_number < meeting.number:
            return math.inf
        arrived_s = meeting.arrived
        # The time of the other arm's arrival is not known if it has met again since.
        if self.partner_number == meeting.number:
            arrived_s = max(arrived_s, self.partner_arrived_s)
        return arrived_s + self._meeting_s

    def step(self, time_s: float, hold: bool) -> None:
        """Advance to the sample at `time_s`. With `hold`, ramp to rest and begin no request."""
        self._time_s = time_s
        super().step(time_s, hold)

    def _is_done(self, current: MotionRequest) -> bool:
        """Return True if the current request is done. A MEET arrives in its first cycle at rest."""
        if current.kind != MotionKind.MEET:
            return super()._is_done(current)
        meeting = self.meeting
        if not self.motion.is_settled:
            return False
        if meeting.request != current.id:
            meeting.request = current.id
            meeting.number += 1
            meeting.arrived = self._time_s
        late_s = self._time_s - self.start_s
        if late_s < -ROUNDING_S:
            return False
        meeting.begun = meeting.number
        meeting.start = self._time_s
        meeting.late = late_s if late_s > self._tools.period_s else 0.0
        return True

    def _find_request_error(self, request: MotionRequest) -> str:
        """Return why a request cannot be executed, or an empty string if no reason is found."""
        return "" if request.kind == MotionKind.MEET else super()._find_request_error(request)


class MeetingTrajectoryExecutor(TrajectoryExecutor):
    """A trajectory level that also meets another arm, whose rack is a partner on the network."""

    partner = Input(Meeting, "lan.meeting")
    presence = Input(PeerPresence, "lan.peer")
    last_meeting = Input(Meeting, "own.meeting")
    meeting = Output(Meeting)
    params: ClassVar[type[TrajectoryParams]] = MeetingParams
    work_class: ClassVar[type[RequestWork]] = MeetingWork
    _work: MeetingWork

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._has_started = False

    def process(self, tick: int) -> None:
        """Take the partner's last arrival, then advance the motion."""
        work = self._work
        if not self._has_started:
            self._has_started = True
            work.meeting = self.meeting
            if self.last_meeting.has_message:
                self.meeting.copy_from(self.last_meeting.message)
        partner = self.partner.message
        work.partner_number = partner.number
        work.partner_arrived_s = partner.arrived - self.presence.message.ahead
        super().process(tick)

    def _find_wait_reason(self) -> str:
        """Return why the motion does not continue, or an empty string if it does."""
        current = self._agenda.current
        reason = super()._find_wait_reason()
        if reason or current is None or current.kind != MotionKind.MEET:
            return reason
        is_absent = self.partner.is_lost or not self.partner.has_message
        return f"meeting {self.meeting.number}: the other arm's rack is absent" if is_absent else ""
