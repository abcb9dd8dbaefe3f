"""All loops of one finger on one board, by the laws of the boards that run one loop of all
fingers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.robot import dynamics
from rack.levels.systems.hand import joint_law, tendon_law
from rack.levels.systems.hand.fingertip_law import FingertipGains, FingertipLaw
from rack.levels.systems.hand.fingertip_loop import follow_grasp
from rack.levels.systems.hand.joint_law import JointGains, JointLaw
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.loop import HandLoop
from rack.levels.systems.hand.messages import (
    FINGER_STATUS,
    FINGER_TARGET,
    GRASP_TARGET,
    HAND_STATUS,
    TENSION_COMMAND,
)
from rack.levels.systems.hand.tendon_law import TendonGains, TendonLaw
from rack.levels.tables import read_params


class FingerParams(FingertipGains, JointGains, TendonGains):
    """`[board.<name>.params]` of a board that runs all loops of a finger."""

    finger: str = Field(description="name of the finger, of robot.hand.finger")


class FingerExecutor(HandLoop):
    """Drives the tendons of one finger as the grasp loop wants; holds it where it found it until
    there is a target.

    After a restart it holds the finger where it is, or goes on with the newest command of the grasp
    loop.
    """

    inputs = {
        "command": Input(GRASP_TARGET, "above.command"),
        "hand": Input(HAND_STATUS, "below.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"command": TENSION_COMMAND, "status": FINGER_STATUS}
    params = FingerParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(FingerParams, context.params)
        hand = self.hand
        finger = hand.names.index(params.finger)
        self.driven = np.arange(len(hand.names)) == finger
        self._joints = hand.fingers[finger]
        self._tip = FingertipLaw(
            FingerKinematics(self.cell, hand), [finger], params, context.period_s
        )
        self._servo = JointLaw(self.cell, self._joints, params)
        self._tendons = TendonLaw(hand, self._joints, params, context)
        self._target = Message(FINGER_TARGET.dtype(context.sizes))
        self._torque = np.zeros(len(self._joints))

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level."""
        for module in (dynamics, joint_law, tendon_law):
            module.preload()

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Iterable[tuple[str, Any, str]]:
        """Yield a finger that the hand does not have, in addition to a lack of a hand or of
        neighbours."""
        yield from super().misfits(context, above, below)
        hand = context.robot.hand
        name = read_params(FingerParams, context.params).finger
        if hand is not None and name not in (names := [finger.name for finger in hand.finger]):
            yield "params.finger", name, f"the hand has no such finger; fingers: {', '.join(names)}"

    def meet(self, read: Ports, hand: Message) -> None:
        """Hold the joints where they are."""
        self._tip.start(hand.position)
        self._tendons.start(hand)
        self._target.position = hand.position
        self._target.stiff = 1.0
        self._servo.start(hand, self._target)

    def follow(self, hand: Message, write: Ports, tick: int) -> None:
        """Write the tensions of the finger's tendons."""
        follow_grasp(self, self._tip, hand, self._target, write.status, tick)
        self._servo.torques(self.age_s(hand, tick), 0.0, self._torque)
        self._tendons.tensions(self._torque, write.command.tension)
        write.command.driven = self._joints
        write.command.sampled = hand.tick
