"""The gateway where the level above runs in another rack, and a network is the link."""

from __future__ import annotations

from pydantic import Field

from rack.backplane.message import Message, State
from rack.levels.level import Input, LevelContext, Output, Ports, Reading
from rack.levels.messages import TASK_STATUS
from rack.levels.peer import PEER, Presence
from rack.levels.servo.reference import MAX_AHEAD_S
from rack.levels.systems.joint_boards.gateway import (
    LEAD_CYCLES,
    GatewayParams,
    JointGateway,
    take_arrived,
)
from rack.levels.systems.joint_boards.messages import JOINT_REFERENCE, JOINT_STATUS
from rack.levels.tables import Positive, read_params

LOST = "the other rack is lost"
NOT_COMPARED = "the clocks of both racks are not compared yet"
STATUS_CYCLES = 10
"""Cycles of this board from status to status: at 500 Hz no more often than a network permits."""
SLACK_S = 0.002
"""Error of the other rack's time that is left alone: correcting it would jolt the motion."""


class NetworkGatewayParams(GatewayParams):
    """`[board.<name>.params]`: the link, and the rack at its other end."""

    period: Positive = Field(0.02, le=1.0)
    """time from reference to reference, s"""
    tick: Positive = Field(0.001, le=1.0)
    """length of a tick of the rack that sends references, s"""


class NetworkGateway(JointGateway):
    """Follows references of another rack, due later by `delay`, within which they must have come.

    They are due at ticks of that rack, whose time next to ours its `PEER` shows. The board is DONE,
    or in ERROR, when the program of that rack is: then it may end the run.
    """

    inputs = {
        "command": Input(JOINT_REFERENCE, "lan.reference"),
        "program": Input(TASK_STATUS, "lan.program"),
        "peer": Input(PEER, "lan.peer"),
        "statuses": JointGateway.inputs["statuses"],
    }
    outputs = {
        "command": JOINT_REFERENCE,
        "status": Output(JOINT_STATUS, cycles=STATUS_CYCLES, rests_on="statuses"),
    }
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
        self._arrived = Message(JOINT_REFERENCE.dtype(context.sizes))
        self._refused = ""  # why the newest reference was not taken
        self._their_s = 0.0  # simulated time there less that here
        self._program: Message

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Hand references down, and statuses up."""
        peer: Message = read.peer.value
        self._follow(peer.ahead)
        super().process(read, write, tick)
        if peer.presence != Presence.THERE or peer.uncertainty < 0.0:
            # Its references would not be followed, and its motion would begin without the arm.
            write.status.stopped = True
            is_lost = peer.presence == Presence.LOST
            write.status.reason = LOST if is_lost else NOT_COMPARED
        elif self._refused:
            write.status.state = State.HOLDING
            write.status.reason = self._refused
        program: Message = read.program.value
        if program.state in (State.DONE, State.ERROR):
            write.status.state = program.state
            write.status.error = program.error
            write.status.reason = program.reason

    def _follow(self, ahead_s: float) -> None:
        """Take over the other rack's time while no reference is followed; later only approach it:
        the clocks drift."""
        apart_s = ahead_s - self._their_s
        if not self._due:
            self._their_s = ahead_s
        elif abs(apart_s) > SLACK_S:
            step_s = self.context.tick_s / STATUS_CYCLES
            self._their_s += step_s if apart_s > 0.0 else -step_s

    def _take(self, command: Reading, tick: int) -> None:
        """Hand on what is new when the boards below need it, at ticks of this rack."""
        if command.is_new:
            arrived = self._arrived
            arrived.copy_from(command.value)
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
