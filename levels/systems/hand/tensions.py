"""The tensions of several boards as those of one hand, while all of them are fresh."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.arm.above import CommandsAbove
from rack.levels.level import Finding, LevelContext, Reading
from rack.levels.robot.hand import Hand
from rack.levels.robot.limits import MotorPatience
from rack.levels.systems.hand.messages import EXTENSOR

MARGIN = 1e-3
"""Part of its largest tension by which one may miss its limits without count: rounding of whoever
kept them."""


class Tensions(CommandsAbove):
    """Joins the `TENSION_COMMAND`s of the boards above, each for the joints that it drives."""

    def __init__(self, context: LevelContext, hand: Hand, patience: MotorPatience) -> None:
        # A tension takes a cycle of its board, and one of the board that gave that the torque.
        super().__init__(context, patience, 2, "tensions", "valves closed")
        self._joints = context.robot.joints
        self._low = hand.least
        self._high = hand.most
        self._margin = MARGIN * hand.most
        self.tension = np.zeros((2, len(hand.most)))  # N
        self.rests_on = 0  # serial of the newest command of an operator that the tensions rest on

    def join(self, tensions: Mapping[str, Reading]) -> None:
        """Set `tension` and `rests_on`, while nothing is `missing`."""
        self.rests_on = 0
        for board in self.oldest:
            value = tensions[board].value
            self.rests_on = max(self.rests_on, value.operator)
            np.copyto(self.tension, value.tension, where=value.driven != 0)

    def check(self) -> tuple[Finding | None, str]:
        """Cut `tension` to its limits. Return what was cut, or refused, and why it is refused;
        empty: it is not."""
        tension = self.tension
        low = self._low
        high = self._high
        within = (tension >= low - self._margin) & (tension <= high + self._margin)  # NaN is not
        if within.all():
            np.clip(tension, low, high, out=tension)
            return None, ""
        if not np.isfinite(tension).all():
            row, joint = np.argwhere(~np.isfinite(tension))[0].tolist()
            return Finding(
                Alarm.TENSION_INVALID, joint
            ), f"rejected: tension of {self._named(row, joint)} is NaN"
        row, joint = np.argwhere(~within)[0].tolist()
        found = Finding(Alarm.TENSION_LIMIT, joint, float(tension[row, joint]))
        np.clip(tension, low, high, out=tension)
        return found, ""

    def _named(self, row: int, joint: int) -> str:
        return f"'{self._joints[joint]}', {'extensor' if row == EXTENSOR else 'flexor'}"
