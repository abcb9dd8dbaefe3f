"""How a level follows its operator: what stands, what it rests on, and what the status says of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import Message
from rack.levels.operator import Answer, Commands, Goal, What, listed, told

DOING = {What.HOLD: "held", What.SETPOINT: "kept at a set point", What.GOTO: "diverted"}
"""What an operator does to a level, in words."""
HELD_FROM_ABOVE = "held by the level above"
"""Reason of a level that is held from above. Above it is no news, and not passed on."""
ABOVE_LOST = "no command from the level above: held until its board is back"
BELOW_LOST = "no status from the level below: waiting for its board"


class Orders:
    """The operator's commands to one level. `standing` is what it is to do: HOLD, SETPOINT or GOTO; NONE: its own work.

    `serial` is the newest command's, and `basis` that of the newest which was not refused. A refused command leaves
    standing what stood, also on a board that comes back: it takes up every command again, in their order.
    """

    def __init__(self, commands: Commands) -> None:
        self._commands = commands
        self.serial = self.basis = 0
        self.standing = What.NONE
        self.answer = Answer.NONE
        self._objection = ""
        self._before = 0, What.NONE
        self._is_told = False

    def take(self, operator: Reading, judge: Callable[[Message], None] | None = None) -> bool:
        """Look into the mailbox; True in the cycle that takes up a command.

        `judge` is called with each one taken up: where a level has objections of its own, it refuses the command there.
        """
        if not operator.is_new:
            return False
        taken = False
        for message in (*operator.earlier, operator.value):
            if self._take_up(message):
                taken = True
                if judge is not None:
                    judge(message)
        return taken

    def _take_up(self, message: Message) -> bool:
        # Once only: a clock that died while it gave it gives it again.
        if message.id <= self.serial:
            return False
        self._before = self.basis, self.standing
        self.serial, self._objection, self._is_told = message.id, "", False
        what, goal = message.what, message.goal
        if what not in self._commands or goal not in (self._commands[What(what)] or (Goal.NONE,)):
            self.refuse(f"{told(what, goal)} is nothing for this level; permitted: {listed(self._commands)}")
            return False
        resumes = what == What.RESUME
        self.basis = self.serial
        self.standing = What.NONE if resumes else What(what)
        self.answer = Answer.DONE if resumes else Answer.TAKEN
        return True

    def refuse(self, why: str) -> None:
        """Refuse the command just taken up: what stood before stands again."""
        self.basis, self.standing = self._before
        self._answer(Answer.REFUSED, why)

    def fail(self, why: str) -> None:
        """Give up what was taken up: the level holds instead."""
        self.standing = What.HOLD
        self._answer(Answer.REFUSED, why)

    def under_way(self) -> None:
        """Say that a RESUME takes its time."""
        self._answer(Answer.TAKEN)

    def done(self) -> None:
        """Say that what was asked for is done; it stands on."""
        if self.answer is Answer.TAKEN:
            self._answer(Answer.DONE)

    def keeps(self, board: str) -> str:
        """Return the reason for which level `board` does not do its own work; empty: no operator keeps it from that."""
        if self.answer is Answer.REFUSED and self.basis == self.serial:
            return f"{board} held, `resume` goes on: {self._objection}"
        doing = DOING.get(self.standing)
        return f"{board} {doing} by the operator: `resume` releases it" if doing else ""

    def _answer(self, answer: Answer, why: str = "") -> None:
        self.answer, self._objection, self._is_told = answer, why, False

    def rests_on(self, above: int) -> int:
        """Return the newest command that this cycle rests on; `above` is that of the command from above."""
        return max(self.basis, above)

    def report(self, status: Message, above: int = 0) -> None:
        """Fill in the fields of `ANSWER`."""
        status.operator = max(self.basis, above)
        if not self._is_told:
            status.order, status.answer, status.standing = self.serial, self.answer, self.standing
            status.objection = self._objection
            self._is_told = True


def joints_of(message: Message, names: Sequence[str], ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the joint positions, (joints,), rad, of an `OPERATOR_COMMAND`; `ranges` (joints, 2) are permitted.

    Raises `ValueError` that names the joint, its value and the range.
    """
    if message.count != len(names):
        raise ValueError(f"{message.count} joint positions; the arm has {len(names)} joints")
    joints = np.array(message.joints[: message.count])
    for name, value, (low, high) in zip(names, joints, ranges, strict=True):
        # Written so that what is no number is outside.
        if not low <= value <= high:
            raise ValueError(f"joint '{name}' at {value:g} rad; permitted: {low:g} to {high:g}")
    return joints
