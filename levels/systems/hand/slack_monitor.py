"""Finds tendons that stay slack, although a tension is wanted of them: torn ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.level import Finding
from rack.levels.robot.hand import Hand
from rack.levels.systems.hand.messages import EXTENSOR

SLACK_CYCLES = 5
"""Cycles in a row in which a tendon must be slack: a valve that opens takes up to four to tighten
one."""
SLACK_PART = 0.5
"""Part of the least tension below which a tendon is slack: a sound one never gets there, wherever
its tension came from."""


class SlackMonitor:
    """Judges the tensions sensed in every cycle."""

    def __init__(self, hand: Hand, joints: Sequence[str]) -> None:
        self._joints = joints
        self._least = hand.least
        self._slack = SLACK_PART * hand.least
        self._cycles = np.zeros((2, len(joints)), dtype=int)  # for which each tendon has been slack
        self._any = False  # one was, in the last cycle
        self.note = ""  # which tendons are slack, readable; empty: none

    def look(self, tension: Array, wanted: Array) -> list[Finding]:
        """Return new findings of a cycle; tensions as sensed, and as wanted of the valves, are (2,
        joints), N."""
        if tension.min() >= self._slack and not self._any:
            return []
        slack = (tension < self._slack) & (wanted >= self._least)
        self._cycles = np.where(slack, self._cycles + 1, 0)
        self._any = bool(slack.any())
        torn = np.argwhere(self._cycles >= SLACK_CYCLES).tolist()
        named = (
            f"{'extensor' if row == EXTENSOR else 'flexor'} of '{self._joints[joint]}'"
            for row, joint in torn
        )
        self.note = f"slack: {', '.join(named)}" if torn else ""
        found = np.argwhere(self._cycles == SLACK_CYCLES).tolist()
        return [Finding(Alarm.TENDON, joint, float(tension[row, joint])) for row, joint in found]
