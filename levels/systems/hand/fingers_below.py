"""The fingers as the grasp loop sees them: the boards below, one for all fingers or one a finger,
as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rack.levels.algebra import Ints
from rack.levels.level import LevelContext, Reading
from rack.levels.messages import Error


class FingersBelow:
    """Merges `FINGER_STATUS`es; each board fills what is its own. Points and forces are in the
    frame of the palm."""

    def __init__(self, context: LevelContext, fingers: Sequence[Ints]) -> None:
        """`fingers` are the joints of each finger, as indices of `robot.joints`."""
        self._joints = fingers
        joints = context.sizes["joints"]
        count = len(fingers)
        self.position = np.zeros(joints)  # (joints,), rad: as sensed
        self.target = np.zeros(joints)  # (joints,), rad: wanted by the loops below
        self.tip = np.zeros((count, 3))  # m
        self.force = np.zeros((count, 3))  # N: of the surroundings on the tips
        self.awaited = ""  # why the fingers do not follow; empty: they do
        self.error = Error.NONE  # of the hand
        self.rests_on = 0  # newest command of an operator that all boards rest on

    def look(self, statuses: Mapping[str, Reading]) -> None:
        """Read the statuses of all boards."""
        self.awaited = ""
        self.error = Error.NONE
        for board, reading in statuses.items():
            status = reading.value
            if reading.is_lost or not reading.is_there:
                self.awaited = f"no status from '{board}': waiting for its board"
                continue
            if status.stopped and not self.awaited:
                self.awaited = f"{board}: {status.reason or 'it does not follow'}"
            self.error = self.error or Error(status.error)
            for finger in np.flatnonzero(status.driven).tolist():
                own = self._joints[finger]
                self.position[own] = status.position[own]
                self.target[own] = status.target[own]
                self.tip[finger] = status.tip[finger]
                self.force[finger] = status.force[finger]
        self.rests_on = min(reading.value.operator for reading in statuses.values())
