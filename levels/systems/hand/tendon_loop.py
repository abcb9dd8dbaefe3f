"""The tendon loop: tensions of all tendons of a hand, from the torques that the joint loop
wants."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.systems.hand import tendon_law
from rack.levels.systems.hand.loop import HandLoop
from rack.levels.systems.hand.messages import (
    HAND_STATUS,
    LOOP_STATUS,
    TENDON_TORQUE,
    TENSION_COMMAND,
)
from rack.levels.systems.hand.tendon_law import TendonGains, TendonLaw
from rack.levels.tables import read_params


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

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        gains = read_params(TendonGains, context.params)
        self._law = TendonLaw(self.hand, self.driven, gains, context)

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level."""
        tendon_law.preload()

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
