"""The fingertip loop: targets of all joints of a hand, from what the grasp loop wants of its
fingers."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.systems.hand.fingertip_law import FingertipGains, FingertipLaw
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.loop import HandLoop
from rack.levels.systems.hand.messages import (
    FINGER_STATUS,
    FINGER_TARGET,
    GRASP_TARGET,
    HAND_STATUS,
    LOOP_STATUS,
)
from rack.levels.tables import read_params


class FingertipLoop(HandLoop):
    """Turns postures, points and forces of fingers into targets of joints. See `FingertipLaw`.

    A restarted board continues from the targets that it gave last.
    """

    inputs = {
        "command": Input(GRASP_TARGET, "above.command"),
        "hand": Input(HAND_STATUS, "hand.status"),
        "below": Input(LOOP_STATUS, "below.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
        "last": Input(FINGER_TARGET, "own.command"),
    }
    outputs = {"command": FINGER_TARGET, "status": FINGER_STATUS}
    params = FingertipGains

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(self.hand.names), True)
        kinematics = FingerKinematics(self.cell, self.hand)
        gains = read_params(FingertipGains, context.params)
        self._law = FingertipLaw(kinematics, range(len(self.driven)), gains, context.period_s)

    def meet(self, read: Ports, hand: Message) -> None:
        """Begin where the joints are, or with the last targets."""
        last = read.last.value
        begin = last if read.last.is_there and last.active else hand
        self._law.start(begin.position)

    def follow(self, hand: Message, write: Ports, tick: int) -> None:
        """Write the targets of the joints."""
        follow_grasp(self, self._law, hand, write.command, write.status, tick)


def follow_grasp(
    loop: HandLoop, law: FingertipLaw, hand: Message, target: Message, status: Message, tick: int
) -> None:
    """Fill a `FINGER_TARGET` for the `GRASP_TARGET` that a loop follows, and the
    `FINGER_STATUS`."""
    status.tip = law.sense(hand.position)
    target.active = loop.command.active
    if loop.command.active:
        law.targets(loop.command, loop.ahead_s(tick), target)
    status.position = hand.position
    status.target = law.wanted
    status.force[loop.driven] = hand.force[loop.driven]
