"""Executors of a board between a trajectory level and boards that servo joints.

The board bridges a link with a delay, or a network if the level above runs in another rack.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from rack.backplane.message import Message, State
from rack.levels.level import Executor, Input, Inputs, LevelContext, Output, Reading
from rack.levels.messages import TaskStatus
from rack.levels.peer import PeerPresence, Presence
from rack.levels.servo.reference import MAX_AHEAD_S
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.tables import NotNegative, Positive, Table

LEAD_CYCLES = 2
"""Cycles that a reference takes from its arrival at this board to the boards below."""

Link = deque[tuple[int, bytes]]
"""Messages in transit, each with its tick of arrival."""


class GatewayParams(Table):
    """`[board.<name>.params]`: the link to the level above, and missing references."""

    delay: NotNegative = Field(0.0, le=1.0)
    """delay of the link in each direction [s]"""
    missing: int = Field(5, ge=0, le=1000)
    """consecutive references that may be missing and are extrapolated"""


class JointGateway(Executor):
    """Passes references to the boards below after a constant delay, and extrapolates missing ones.

    A reference that does not arrive in time is extrapolated from the newest one at its velocity.
    After `missing` extrapolated references it passes none down, so the boards below ramp to rest
    and hold; when references arrive again, these boards follow them again. To the level above, the
    boards below appear as one.

    Attributes:
        latency: Ticks that are added to the due tick of a reference.
    """

    above = Input(JointReference, "above.command")
    statuses = Inputs(JointStatus, "below.status")
    command = Output(JointReference, rests_on=above)
    status = Output(JointStatus, rests_on=statuses)
    params: ClassVar[type[GatewayParams]] = GatewayParams
    settings: GatewayParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        every = context.every
        # Ticks, rounded up to whole cycles.
        self._delay = -(-round(params.delay / context.tick_s) // every) * every
        self.latency = self._delay + LEAD_CYCLES * every
        self._missing = params.missing
        # Ticks from reference to reference. 0 if the level above belongs to another rack.
        self._period = max((pace.every for pace in context.above.values()), default=0)
        self._above = ", ".join(context.above)
        self._down: Link = deque()
        self._up: Link = deque()
        self._newest = JointReference.zeros(context.sizes)  # newest reference that has arrived
        self._merged = JointStatus.zeros(context.sizes)  # status of the boards below as one
        self._frozen = False  # too many references are missing

    def process(self, tick: int) -> None:
        """Pass references down and statuses up."""
        self._take_reference(self.above, tick)
        newest = self._newest
        due = newest.due + self.latency if newest.due else 0
        if not due or due > max(self.command.due, tick):
            self.command.raw[:] = newest.raw
            self.command.due = due
            self._frozen = False
        elif self.command.due and tick + LEAD_CYCLES * self.context.every > self.command.due:
            self._extrapolate_reference(self.command)
        # Send the status of the boards below over the delayed link, and write the status that has
        # arrived.
        self._merge_statuses(self.statuses)
        self._up.append((tick + self._delay, bytes(self._merged.raw)))
        deliver_arrived(self._up, self.status, tick)

    def _take_reference(self, command: Reading[JointReference], tick: int) -> None:
        """Send a new reference over the delayed link, and accept the newest that has arrived."""
        if command.is_new:
            self._down.append((tick + self._delay, bytes(command.message.raw)))
        deliver_arrived(self._down, self._newest, tick)

    def _extrapolate_reference(self, command: JointReference) -> None:
        """Extrapolate the next reference, or pass none down if too many are missing."""
        newest = self._newest
        ahead_ticks = command.due + self._period - self.latency - newest.due
        if ahead_ticks > self._missing * self._period:
            command.due = 0
            self._frozen = True
            return
        command.due += self._period
        ahead_s = ahead_ticks * self.context.tick_s
        command.id = newest.id
        command.position[:] = newest.position + ahead_s * newest.velocity
        command.velocity[:] = newest.velocity
        command.acceleration[:] = 0.0

    def _merge_statuses(self, statuses: Mapping[str, Reading[JointStatus]]) -> None:
        """Combine the statuses of the boards below into one."""
        merged = self._merged
        values = [reading.message for reading in statuses.values()]
        merged.position[:] = values[0].position
        for name in ("target", "target_velocity", "torque", "driven"):
            field = getattr(merged, name)
            field[:] = 0
            for value in values:
                field += getattr(value, name)
        silent = [
            board
            for board, reading in statuses.items()
            if reading.is_lost or not reading.has_message
        ]
        worst = max(values, key=lambda value: (value.error > 0, value.stopped, value.holding))
        merged.holding = any(value.holding for value in values)
        merged.stopped = bool(silent) or any(value.stopped for value in values)
        merged.echo = min(value.echo for value in values)
        merged.due = min(value.due for value in values)
        merged.operator = max(value.operator for value in values)
        merged.state = worst.state
        merged.error = worst.error
        merged.reason = worst.reason
        if silent:
            merged.state = State.HOLDING
            merged.reason = f"no status from '{silent[0]}': waiting for its board"
        elif self._frozen and not worst.stopped:
            late = f"no reference from '{self._above}'"
            merged.state = State.HOLDING
            merged.reason = f"{late}: held after {self._missing} extrapolated"


def deliver_arrived(link: Link, message: Message, tick: int) -> None:
    """Replace `message` with the newest one that has arrived by `tick`, if there is one.

    Args:
        link: Link, from which arrived messages are removed.
        message: Message to replace.
        tick: Present tick.
    """
    while link and link[0][0] <= tick:
        message.raw[:] = link.popleft()[1]


LOST = "the other rack is lost"
NOT_COMPARED = "the clocks of both racks are not compared yet"
STATUS_CYCLES = 10
"""Cycles of this board from status to status, which at 500 Hz suits a network."""
SLACK_S = 0.002
"""Error of the other rack's time that is not corrected, because that would jolt the motion."""


class NetworkGatewayParams(GatewayParams):
    """`[board.<name>.params]`: the link, and the rack at its other end."""

    period: Positive = Field(0.02, le=1.0)
    """time from reference to reference [s]"""
    tick: Positive = Field(0.001, le=1.0)
    """length of a tick of the rack that sends references [s]"""


class NetworkGateway(JointGateway):
    """Passes on references of another rack, and adds `delay` to the time at which they are due.

    References must arrive within this delay. Their due ticks refer to the clock of the other rack;
    its `PeerPresence` contains the difference between the clocks. The board reports DONE or ERROR
    when the program of the other rack does, so that it can end the run.
    """

    above = Input(JointReference, "lan.reference")
    task = Input(TaskStatus, "lan.program")
    peer = Input(PeerPresence, "lan.peer")
    command = Output(JointReference, rests_on=above)
    status = Output(JointStatus, cycles=STATUS_CYCLES, rests_on=JointGateway.statuses)
    params = NetworkGatewayParams
    settings: NetworkGatewayParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        self._delay = 0  # statuses are not delayed, because the network already does that
        self._period = round(params.period / context.tick_s)
        self._tick_s = params.tick
        # Ticks before it is due at which a reference is passed down, because then the boards below
        # begin to interpolate to it.
        self._lead_ticks = self._period + LEAD_CYCLES * context.every
        self._above = "lan"
        self._arrived = JointReference.zeros(context.sizes)
        self._refused = ""  # why the newest reference was refused
        self._their_s = 0.0  # simulated time of the other rack minus this rack's

    def process(self, tick: int) -> None:
        """Pass references down and statuses up; report the state of the other rack."""
        peer = self.peer.message
        self._follow_clock(peer.ahead)
        super().process(tick)
        if peer.presence != Presence.THERE or peer.uncertainty < 0.0:
            # The references could not be followed, so the other rack must not begin to move.
            self.status.stopped = True
            self.status.reason = LOST if peer.presence == Presence.LOST else NOT_COMPARED
        elif self._refused:
            self.status.state = State.HOLDING
            self.status.reason = self._refused
        program = self.task.message
        if program.state in (State.DONE, State.ERROR):
            self.status.state = program.state
            self.status.error = program.error
            self.status.reason = program.reason

    def _follow_clock(self, ahead_s: float) -> None:
        """Update the difference between the clocks of the two racks, because they drift apart.

        While references are followed, the difference changes only in small steps, so that the
        motion does not jerk.

        Args:
            ahead_s: Newest time of the other rack minus the time of this one.
        """
        apart_s = ahead_s - self._their_s
        if not self.command.due:
            self._their_s = ahead_s
        elif abs(apart_s) > SLACK_S:
            step_s = self.context.tick_s / STATUS_CYCLES
            self._their_s += step_s if apart_s > 0.0 else -step_s

    def _take_reference(self, command: Reading[JointReference], tick: int) -> None:
        """Convert a new reference to this rack's clock, and pass it on when the boards need it.

        A reference that is due too far in the future or past is refused.

        Args:
            command: Newest reference and its verdict.
            tick: Tick of the cycle.
        """
        if command.is_new:
            arrived = self._arrived
            arrived.copy_from(command.message)
            arrived.operator = 0  # serials of the other rack's operators have no meaning here
            self._refused = ""
            if arrived.due:
                due_s = arrived.due * self._tick_s - self._their_s
                ahead_s = due_s - tick * self.context.tick_s
                if abs(ahead_s) > MAX_AHEAD_S:
                    self._refused = f"rejected: a reference due in {ahead_s:.3g} s"
                    return
                arrived.due = round(due_s / self.context.tick_s)
            begins = arrived.due + self.latency - self._lead_ticks if arrived.due else tick
            self._down.append((begins, bytes(arrived.raw)))
        deliver_arrived(self._down, self._newest, tick)
