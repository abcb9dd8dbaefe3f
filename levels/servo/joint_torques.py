"""The torques of several boards as those of one arm, while all of them are fresh."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.arm.arm import PATIENCE_CYCLES
from rack.levels.compiled import compiled
from rack.levels.level import LevelContext, Reading, Verdict
from rack.levels.robot.dynamics import Payload
from rack.levels.robot.engine import one_view
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import numbers


class JointTorques:
    """Adds up the `JOINT_TORQUE`s of the boards above; each is 0 for the joints of other boards."""

    def __init__(self, context: LevelContext, joints: int) -> None:
        # A torque rests on a status of a cycle ago and takes a cycle of its board; then the motors keep it.
        self.oldest = {  # ticks, by board
            board: context.every + (1 + PATIENCE_CYCLES) * pace.every for board, pace in context.above.items()
        }
        self._sum = np.zeros(3 * joints + 5)  # the fields of a `JOINT_TORQUE` from `torque` to `payload_offset`
        self.torque = self._sum[:joints]  # (joints,), N m
        self._offset = self._sum[-3:]
        self.wanted = Motion(np.zeros((3, joints)))  # where the boards want the joints; accelerations are not known
        self.moves = False  # a joint is wanted to move
        self.rests_on = 0  # serial of the newest command of an operator that the torques rest on
        self._messages: dict[str, Message] = {}
        self._memory, self._begins = self._sum, np.zeros(0, dtype=np.int64)  # of the messages
        self._add_up = add_up.load()

    @property
    def grip_force(self) -> float:
        """The gripper's force, N."""
        return float(self._sum[-5])

    @property
    def payload(self) -> Payload:
        """The mass in the gripper, as the boards know it."""
        return Payload(float(self._sum[-4]), self._offset)

    def missing(self, torques: Mapping[str, Reading], tick: int, since: int) -> str:
        """Return why torques are missing at `tick`; empty: all are fresh, and rest on a status of `since` or later."""
        all_know = True
        for board, oldest in self.oldest.items():
            value, verdict, is_lost, _ = torques[board]
            if is_lost:
                return f"board '{board}' is lost: braked until it is back"
            sampled = -1 if verdict is Verdict.NONE else value.sampled
            if sampled < 0:
                return f"no torque from board '{board}' yet"
            if tick - sampled > oldest:
                return f"torque of board '{board}' is stale: it rests on a status more than {oldest} ticks old"
            all_know = all_know and sampled >= since
            if self._messages.get(board) is not value:
                self._see(board, value)
        return "" if all_know else "braked until the boards above have seen it"

    def add_up(self) -> None:
        """Set `torque`, `wanted`, `grip_force` and `payload`, while nothing is `missing`."""
        self.rests_on = max([message.operator for message in self._messages.values()], default=0)
        self.moves = self._add_up(self._sum, self.wanted.table, self._memory, self._begins)

    def _see(self, board: str, message: Message) -> None:
        """Find the numbers of a message: those of the next ones of its board are in the same place."""
        self._messages[board] = message
        views = [numbers(m, "torque", "payload_offset") for m in self._messages.values()]
        self._memory, self._begins = one_view(*views)


@compiled
def add_up(
    total: Array,  # (3 joints + 5,): set
    motion: Array,  # (3, joints), rad, rad/s: set, but for the accelerations
    memory: Array,
    begins: NDArray[np.int64],  # (boards,): where in `memory` the numbers of a board begin
) -> bool:
    """Add up the numbers of messages; return whether a joint is wanted to move."""
    joints, moves = motion.shape[1], False
    for number in range(len(total)):
        total[number] = 0.0
        for board in range(len(begins)):
            total[number] += memory[begins[board] + number]
    for j in range(joints):
        motion[0, j], motion[1, j] = total[joints + j], total[2 * joints + j]
        moves = moves or motion[1, j] != 0.0
    return moves


def preload() -> None:
    """Load this module's compiled function."""
    numbers = np.zeros(8)
    add_up.load()(numbers, np.zeros((3, 1)), numbers, np.zeros(0, dtype=np.int64))
