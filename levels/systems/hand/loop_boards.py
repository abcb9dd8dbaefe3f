"""The boards that run the loops of a hand: one loop of all fingers each, or all loops of one
finger, by the same laws.

With one loop each, the fingertip loop turns what the grasp loop wants into targets of all joints,
the joint loop these into torques, and the tendon loop these into tensions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Misfits, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.robot import dynamics
from rack.levels.systems.hand import joint_law, tendon_law
from rack.levels.systems.hand.fingertip_law import FingertipGains, FingertipLaw
from rack.levels.systems.hand.joint_law import JointGains, JointLaw
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.loop import HandLoop
from rack.levels.systems.hand.messages import (
    FINGER_STATUS,
    FINGER_TARGET,
    GRASP_TARGET,
    HAND_STATUS,
    LOOP_STATUS,
    TENDON_TORQUE,
    TENSION_COMMAND,
)
from rack.levels.systems.hand.tendon_law import TendonGains, TendonLaw
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
    preloads = (dynamics, joint_law)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        self._law = JointLaw(self.cell, self.driven, read_params(JointGains, context.params))

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


class TendonLoop(HandLoop):
    """Gives the hand a tension for each tendon, in every cycle. See `TendonLaw`.

    What it commands rests on the status of the hand on which the torques rest: the hand thus
    notices a joint loop that is gone, too.
    """

    inputs = {
        "command": Input(TENDON_TORQUE, "above.command"),
        "hand": Input(HAND_STATUS, "below.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"command": TENSION_COMMAND, "status": LOOP_STATUS}
    params = TendonGains
    preloads = (tendon_law,)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        gains = read_params(TendonGains, context.params)
        self._law = TendonLaw(self.hand, self.driven, gains, context)

    def meet(self, read: Ports, hand: Message) -> None:
        """Begin with the tensions that are there."""
        self._law.start(hand)

    def follow(self, hand: Message, write: Ports, tick: int) -> None:
        """Write the tensions for the newest torques."""
        command = write.command
        command.driven = self.driven
        command.sampled = min(hand.tick, self.command.sampled) if self.commanded else -1
        if command.sampled >= 0:
            self._law.tensions(self.command.torque, command.tension)
        write.status.clipped = self._law.clipped


class FingerParams(FingertipGains, JointGains, TendonGains):
    """`[board.<name>.params]` of a board that runs all loops of a finger."""

    finger: str
    """name of the finger, of robot.hand.finger"""


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
    preloads = (dynamics, joint_law, tendon_law)

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
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
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
