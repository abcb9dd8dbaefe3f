"""Executors of a board that joins a trajectory level to boards that servo joints: across a link
with a delay, or across a network, where the level above runs in another rack.
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
from rack.levels.tables import NotNegative, Positive, Table, read_params

LEAD_CYCLES = 2
"""Cycles of this board until a reference that is there has come to the boards below: they need it
in time."""

Link = deque[tuple[int, bytes]]
"""Messages on their way, each with the tick at which it arrives."""


class GatewayParams(Table):
    """`[board.<name>.params]`: the link to the level above, and what to do without it."""

    delay: NotNegative = Field(0.0, le=1.0)
    """time that the link takes, each way [s]"""
    missing: int = Field(5, ge=0, le=1000)
    """references in a row that may be missing and are extrapolated"""


class JointGateway(Executor):
    """Hands references on to the boards below, later by a constant time; makes up those that are
    missing.

    A reference that is not there in time is extrapolated from the newest, at its velocity. After
    `missing` of them the arm is left to the boards below, which ramp to rest and hold; when
    references come again, they join them. Upwards the boards below appear as one.
    """

    above = Input(JointReference, "above.command")
    statuses = Inputs(JointStatus, "below.status")
    command = Output(JointReference, rests_on=above)
    status = Output(JointStatus, rests_on=statuses)
    params: ClassVar[type[GatewayParams]] = GatewayParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(self.params, context.params)
        every = context.every
        # Ticks, in whole cycles.
        self._delay = -(-round(params.delay / context.tick_s) // every) * every
        self.latency = self._delay + LEAD_CYCLES * every  # ticks by which references are due later
        self._missing = params.missing
        # Ticks from reference to reference; none if the level above is not of this rack.
        self._period = max((pace.every for pace in context.above.values()), default=0)
        self._above = ", ".join(context.above)
        self._down: Link = deque()
        self._up: Link = deque()
        self._newest = JointReference.zeros(context.sizes)  # reference that came
        self._merged = JointStatus.zeros(context.sizes)  # of the boards below, as one
        self._due = 0  # tick at which the last reference given is due; 0: none is followed
        self._frozen = False  # too many are missing

    def process(self, tick: int) -> None:
        """Hand references down, and statuses up."""
        self._take(self.above, tick)
        newest = self._newest
        due = newest.due + self.latency if newest.due else 0
        if not due or due > max(self._due, tick):
            self.command.raw[:] = newest.raw
            self._due = self.command.due = due
            self._frozen = False
        elif self._due and tick + LEAD_CYCLES * self.context.every > self._due:
            self._extrapolate(self.command)
        # Put the status of the boards below on the link; show the one that has passed it.
        self._merge(self.statuses)
        self._up.append((tick + self._delay, bytes(self._merged.raw)))
        take_arrived(self._up, self.status, tick)

    def _take(self, command: Reading[JointReference], tick: int) -> None:
        """Put what is new on the link; take what has passed it."""
        if command.is_new:
            self._down.append((tick + self._delay, bytes(command.message.raw)))
        take_arrived(self._down, self._newest, tick)

    def _extrapolate(self, command: JointReference) -> None:
        """Make up the reference after the last one given, or give up."""
        newest = self._newest
        ahead = self._due + self._period - self.latency - newest.due  # ticks
        if ahead > self._missing * self._period:
            self._due = command.due = 0
            self._frozen = True
            return
        self._due += self._period
        ahead_s = ahead * self.context.tick_s
        command.due = self._due
        command.id = newest.id
        command.position[:] = newest.position + ahead_s * newest.velocity
        command.velocity[:] = newest.velocity
        command.acceleration[:] = 0.0

    def _merge(self, statuses: Mapping[str, Reading[JointStatus]]) -> None:
        merged = self._merged
        values = [reading.message for reading in statuses.values()]
        merged.position[:] = values[0].position
        for name in ("target", "target_velocity", "torque", "driven"):
            field = getattr(merged, name)
            field[:] = 0
            for value in values:
                field += getattr(value, name)
        silent = [
            board for board, reading in statuses.items() if reading.is_lost or not reading.is_there
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


def take_arrived(link: Link, message: Message, tick: int) -> None:
    """Let what has arrived by `tick` replace `message`, the newest last."""
    while link and link[0][0] <= tick:
        message.raw[:] = link.popleft()[1]


LOST = "the other rack is lost"
NOT_COMPARED = "the clocks of both racks are not compared yet"
STATUS_CYCLES = 10
"""Cycles of this board from status to status: at 500 Hz no more often than a network permits."""
SLACK_S = 0.002
"""Error of the other rack's time that is left alone: correcting it would jolt the motion."""


class NetworkGatewayParams(GatewayParams):
    """`[board.<name>.params]`: the link, and the rack at its other end."""

    period: Positive = Field(0.02, le=1.0)
    """time from reference to reference [s]"""
    tick: Positive = Field(0.001, le=1.0)
    """length of a tick of the rack that sends references [s]"""


class NetworkGateway(JointGateway):
    """Follows references of another rack, due later by `delay`, within which they must have come.

    They are due at ticks of that rack, whose time next to ours its `PeerPresence` shows. The board
    is DONE, or in ERROR, when the program of that rack is: then it may end the run.
    """

    above = Input(JointReference, "lan.reference")
    task = Input(TaskStatus, "lan.program")
    peer = Input(PeerPresence, "lan.peer")
    command = Output(JointReference, rests_on=above)
    status = Output(JointStatus, cycles=STATUS_CYCLES, rests_on=JointGateway.statuses)
    params = NetworkGatewayParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(NetworkGatewayParams, context.params)
        self._delay = 0  # nothing is held back on the way up: the network takes its own time
        self._period = round(params.period / context.tick_s)
        self._tick_s = params.tick
        # Ticks before a reference is due at which it is handed on: when the boards below begin to
        # interpolate to it.
        self._ahead = self._period + LEAD_CYCLES * context.every
        self._above = "lan"
        self._arrived = JointReference.zeros(context.sizes)
        self._refused = ""  # why the newest reference was not taken
        self._their_s = 0.0  # simulated time there less that here

    def process(self, tick: int) -> None:
        """Hand references down, and statuses up."""
        peer = self.peer.message
        self._follow(peer.ahead)
        super().process(tick)
        if peer.presence != Presence.THERE or peer.uncertainty < 0.0:
            # Its references would not be followed, and its motion would begin without the arm.
            self.status.stopped = True
            is_lost = peer.presence == Presence.LOST
            self.status.reason = LOST if is_lost else NOT_COMPARED
        elif self._refused:
            self.status.state = State.HOLDING
            self.status.reason = self._refused
        program = self.task.message
        if program.state in (State.DONE, State.ERROR):
            self.status.state = program.state
            self.status.error = program.error
            self.status.reason = program.reason

    def _follow(self, ahead_s: float) -> None:
        """Take over the other rack's time while no reference is followed; later only approach it:
        the clocks drift.
        """
        apart_s = ahead_s - self._their_s
        if not self._due:
            self._their_s = ahead_s
        elif abs(apart_s) > SLACK_S:
            step_s = self.context.tick_s / STATUS_CYCLES
            self._their_s += step_s if apart_s > 0.0 else -step_s

    def _take(self, command: Reading[JointReference], tick: int) -> None:
        """Hand on what is new when the boards below need it, at ticks of this rack."""
        if command.is_new:
            arrived = self._arrived
            arrived.copy_from(command.message)
            arrived.operator = 0  # of the other rack's operators, whose numbers mean nothing here
            self._refused = ""
            if arrived.due:
                due_s = arrived.due * self._tick_s - self._their_s
                ahead_s = due_s - tick * self.context.tick_s
                if abs(ahead_s) > MAX_AHEAD_S:
                    self._refused = f"rejected: a reference due in {ahead_s:.3g} s"
                    return
                arrived.due = round(due_s / self.context.tick_s)
            begins = arrived.due + self.latency - self._ahead if arrived.due else tick
            self._down.append((begins, bytes(arrived.raw)))
        take_arrived(self._down, self._newest, tick)
