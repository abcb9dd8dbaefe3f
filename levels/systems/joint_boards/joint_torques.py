"""The torques of several boards as those of one arm, while all of them are fresh."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.arm.above import CommandsAbove
from rack.levels.compiled import compiled_for
from rack.levels.level import LevelContext, Reading
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Payload
from rack.levels.robot.engine import one_view
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import numbers


class JointTorques(CommandsAbove):
    """Adds up the `JOINT_TORQUE`s of the boards above; each is 0 for the joints of other boards."""

    # Addresses in this process, of messages that are seen for the first time again.
    found_again = ("_messages", "_memory", "_begins")

    def __init__(self, context: LevelContext, cell: Cell) -> None:
        super().__init__(context, cell.patience, 1, "torque", "braked")
        joints = len(cell.home)
        # The fields of a `JOINT_TORQUE` from `torque` to `payload_offset`.
        self._sum = np.zeros(3 * joints + 5)
        self.torque = self._sum[:joints]  # (joints,), N m
        self._offset = self._sum[-3:]
        # Where the boards want the joints; accelerations are not known.
        self.wanted = Motion(np.zeros((3, joints)))
        self.moves = False  # a joint is wanted to move
        self.rests_on = 0  # serial of the newest command of an operator that the torques rest on
        self._messages: dict[str, Message] = {}
        self._memory: Array  # of the messages
        self._begins: NDArray[np.int64]  # (boards,): of their numbers, in `_memory`
        self._add_up = add_up.load()

    @property
    def grip_force(self) -> float:
        """The gripper's force, N."""
        return float(self._sum[-5])

    @property
    def payload(self) -> Payload:
        """The mass in the gripper, as the boards know it."""
        return Payload(float(self._sum[-4]), self._offset)

    def missing(self, commands: Mapping[str, Reading], tick: int, since: int) -> str:
        """Return why torques are missing, as `CommandsAbove`; if none is, find their numbers."""
        why = super().missing(commands, tick, since)
        if not why:
            for board in self.oldest:
                value = commands[board].value
                if self._messages.get(board) is not value:
                    # Find the numbers of a message: those of the next ones of its board are
                    # in the same place.
                    self._messages[board] = value
                    views = [
                        numbers(m, "torque", "payload_offset") for m in self._messages.values()
                    ]
                    self._memory, self._begins = one_view(*views)
        return why

    def add_up(self) -> None:
        """Set `torque`, `wanted`, `grip_force` and `payload`, while nothing is `missing`."""
        self.rests_on = max(message.operator for message in self._messages.values())
        self.moves = self._add_up(self._sum, self.wanted.table, self._memory, self._begins)


@compiled_for("f8[::1], f8[:,::1], f8[::1], i8[::1]")
def add_up(
    total: Array,  # (3 joints + 5,): set
    motion: Array,  # (3, joints), rad, rad/s: set, but for the accelerations
    memory: Array,
    begins: NDArray[np.int64],  # (boards,): where in `memory` the numbers of a board begin
) -> bool:
    """Add up the numbers of messages; return whether a joint is wanted to move."""
    joints = motion.shape[1]
    moves = False
    for number in range(len(total)):
        total[number] = 0.0
        for board in range(len(begins)):
            total[number] += memory[begins[board] + number]
    for j in range(joints):
        motion[0, j] = total[joints + j]
        motion[1, j] = total[2 * joints + j]
        moves = moves or motion[1, j] != 0.0
    return moves
