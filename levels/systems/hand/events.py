"""Asynchronous events of a hand: fingertips that touch or leave something.

The fingertip loop sends an event when it happens, at no fixed time. The event server has the lowest
priority and a place in the static schedule where its core is idle. It takes at most one event from
the queue in each minor frame, so that a burst of events is spread over several frames and never
delays a board of the schedule.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray

from rack.backplane.message import Command, State, Status, field, integer_field
from rack.levels.algebra import norm
from rack.levels.level import Executor, Input, LevelContext, Output, QueuedOutput
from rack.levels.messages import joint_field
from rack.levels.robot.cell import build_level_cell
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.loop_boards import FingertipLoop
from rack.levels.systems.hand.messages import HandStatus

TOUCH_N = 0.3
LEAVE_N = 0.1
"""Forces on a tip above which it touches something, and below which it has left it."""
PAD_M = 0.009
"""Distance between the site of a tip and its surface."""


class TipEvent(Command, version=1):
    """From the fingertip loop to the event server."""

    finger: int = integer_field("number of the finger", "u1")
    touches: bool = field(doc="1 if the tip touches something now, 0 if it has left it")
    raised: int = field(unit="tick", doc="cycle that saw the event")
    position: ndarray = joint_field("rad", "joint positions in that cycle")
    force: ndarray = field(unit="N", doc="force on the tip in that cycle", shape=3)


class EventStatus(Status, version=1):
    """From the event server: the event that was served last, and counts.

    `echo` is the id of that event.
    """

    served: int = integer_field("events served")
    touching: ndarray = field(
        "u1", unit="1", doc="1 for fingers whose last event is a touch", shape="fingers"
    )
    contact: ndarray = field(
        unit="m", doc="last point of contact of each tip in the palm's frame", shape=("fingers", 3)
    )
    response: int = field(unit="tick", doc="from the cycle that saw the last event to its service")
    longest: int = field(unit="tick", doc="longest response")


class EventfulFingertipLoop(FingertipLoop):
    """A fingertip loop that sends an event when a tip touches or leaves something."""

    last_status = Input(EventStatus, "events.status")
    events = QueuedOutput(TipEvent)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._touching = np.full(len(self.driven), False)
        self._sent = 0  # id of the newest event

    def start_from(self, hand: HandStatus) -> None:
        """Start, after a restart with the touches and ids that the event server knows."""
        super().start_from(hand)
        self._touching[:] = self.last_status.message.touching != 0
        self._sent = self.last_status.message.echo

    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute the joint targets, and send events. A full queue delays them."""
        super().follow_command(hand, tick)
        for finger, force in enumerate(hand.force):
            touches = norm(force) > (LEAVE_N if self._touching[finger] else TOUCH_N)
            if touches != self._touching[finger]:
                event = self.events.message
                event.id = self._sent + 1
                event.finger = finger
                event.touches = touches
                event.raised = tick
                event.position = hand.position
                event.force = force
                if self.events.send():
                    self._touching[finger] = touches
                    self._sent += 1


class EventServer(Executor):
    """Serves the events of a hand, and computes the points at which tips touch something."""

    events = Input(TipEvent, "fingertip.events")
    before = Input(EventStatus, "own.status")
    status = Output(EventStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_level_cell(context)
        assert cell.hand is not None, "the messages have a size for fingers"
        self._kinematics = FingerKinematics(cell, cell.hand)
        self._has_started = False

    def max_messages(self, port: str) -> int:
        """Take one event in a cycle. The others wait for later frames."""
        return int(self._has_started)

    def process(self, tick: int) -> None:
        """Serve the event that was taken in this cycle, if any."""
        status = self.status
        if not self._has_started:
            self._has_started = True
            if self.before.has_message:
                status.copy_from(self.before.message)
        status.state = State.IDLE
        if self.events.is_new:
            status.state = State.EXECUTING
            self._serve(self.events.message, tick)

    def _serve(self, event: TipEvent, tick: int) -> None:
        """Store an event in the status, with the point of contact if the tip touches something."""
        status = self.status
        finger = event.finger
        status.echo = event.id
        status.served += 1
        status.touching[finger] = event.touches
        status.response = tick - event.raised
        status.longest = max(status.longest, status.response)
        if event.touches:
            self._kinematics.set_position(event.position)
            # The surface pushes the tip away, so it is on the side from which the force comes.
            depth = PAD_M / norm(event.force)
            status.contact[finger] = self._kinematics.find_tip(finger) - depth * event.force
