"""The torques of several boards as those of one arm, while all of them are fresh."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.levels.arm.above import CommandsAbove
from rack.levels.level import LevelContext, Reading
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Payload
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import numbers


class JointTorques(CommandsAbove):
    """Adds up the `JOINT_TORQUE`s of the boards above; each is 0 for the joints of other boards."""

    def __init__(self, context: LevelContext, cell: Cell) -> None:
        super().__init__(context, cell.patience, 1, "torque", "braked")
        joints = len(cell.home)
        # The fields of a `JOINT_TORQUE` from `torque` to `payload_offset`.
        self._sum = np.zeros(3 * joints + 5)
        self.torque = self._sum[:joints]  # (joints,), N m
        # Where the boards want the joints; accelerations are not known.
        self.wanted = Motion(np.zeros((3, joints)))
        self.moves = False  # a joint is wanted to move
        self.rests_on = 0  # serial of the newest command of an operator that the torques rest on

    @property
    def grip_force(self) -> float:
        """The gripper's force, N."""
        return float(self._sum[-5])

    @property
    def payload(self) -> Payload:
        """The mass in the gripper, as the boards know it."""
        return Payload(float(self._sum[-4]), self._sum[-3:])

    def add_up(self, commands: Mapping[str, Reading]) -> None:
        """Set `torque`, `wanted`, `grip_force` and `payload`, while nothing is `missing`."""
        self.rests_on = 0
        self._sum[:] = 0.0
        for board in self.oldest:
            value = commands[board].value
            self.rests_on = max(self.rests_on, value.operator)
            self._sum += numbers(value, "torque", "payload_offset")
        joints = len(self.torque)
        self.wanted.table[:2] = self._sum[joints : 3 * joints].reshape(2, joints)
        self.moves = bool(self.wanted.velocity.any())
