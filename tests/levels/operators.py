"""An operator for tests: commands into the mailboxes of a rack in one process."""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.message import Message
from rack.levels.operator import Goal, Operation
from tests.levels.lockstep import Lockstep


class Operator:
    """Says things to levels; every command has the next serial."""

    def __init__(self, rack: Lockstep) -> None:
        self._rack, self.serial = rack, 0

    def say(self, level: str, what: Operation, joints: Sequence[float] = (), goal: Goal = Goal.NONE) -> int:
        """Give a command now; return its serial. `joints`, rad, are its goal where there are any."""
        message = self._message(level, what, Goal.JOINTS if len(joints) else goal)
        message.count = len(joints)
        message.joints[: len(joints)] = joints
        self._rack.write(f"{level}.operator", message)
        return self.serial

    def goto(self, level: str, position: Sequence[float], direction: Sequence[float]) -> int:
        """Send the tool somewhere, m, with its z axis in a direction; return the serial."""
        message = self._message(level, Operation.GOTO, Goal.DIRECTION)
        message.position, message.direction = position, direction
        self._rack.write(f"{level}.operator", message)
        return self.serial

    def _message(self, level: str, what: Operation, goal: Goal) -> Message:
        self.serial += 1
        message = self._rack.message(f"{level}.operator")
        message.id, message.what, message.goal = self.serial, what, goal
        return message
