"""The joint loop: torques of all joints of a hand, from the targets of the fingertip loop."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.robot import dynamics
from rack.levels.systems.hand import joint_law
from rack.levels.systems.hand.joint_law import JointGains, JointLaw
from rack.levels.systems.hand.loop import HandLoop
from rack.levels.systems.hand.messages import FINGER_TARGET, HAND_STATUS, LOOP_STATUS, TENDON_TORQUE
from rack.levels.tables import read_params


class JointLoop(HandLoop):
    """Brings the joints to their targets with torques; until there are targets it holds them where
    it found them.

    See `JointLaw`.
    """

    inputs = {
        "command": Input(FINGER_TARGET, "above.command"),
        "hand": Input(HAND_STATUS, "hand.status"),
        "below": Input(LOOP_STATUS, "below.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"command": TENDON_TORQUE, "status": LOOP_STATUS}
    params = JointGains

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        self._law = JointLaw(self.cell, self.driven, read_params(JointGains, context.params))

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level."""
        for module in (dynamics, joint_law):
            module.preload()

    def meet(self, read: Ports, hand: Message) -> None:
        """Hold the joints where they are, until there are targets."""
        self.command.position = hand.position
        self.command.stiff = 1.0
        self._law.start(hand, self.command)

    def follow(self, hand: Message, write: Ports, tick: int) -> None:
        """Write the torques for the newest targets."""
        self._law.torques(self.age_s(hand, tick), self.ahead_s(tick), write.command.torque)
        write.command.sampled = hand.tick
        write.status.clipped = self._law.clipped
