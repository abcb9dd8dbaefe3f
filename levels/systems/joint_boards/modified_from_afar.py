"""Control modifications that another rack puts into servo laws, and takes out, over a network.

The message says which are to be in, not what has changed, so none that is lost or overtaken is
missed. While the other rack is lost, they stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from rack.backplane.message import Command, State, Status, field
from rack.levels.level import Executor, Input, Inputs, LevelContext, Output
from rack.levels.operator import AnsweringStatus, Goal, Operation, OperatorCommand, Orders
from rack.levels.systems.joint_boards.joint_servo import JointServo
from rack.levels.tables import Table, read_params

NAME_BYTES = 40
MOST_NAMES = 8
"""Names that one message holds, and the length of each with a space."""
ANSWER_CYCLES = 20
"""Cycles of a joint's board from answer to answer: at 1 kHz as often as a network permits."""


class Modifications(Command, version=1):
    """The control modifications that are to be in force."""

    wanted: str = field(
        f"S{MOST_NAMES * NAME_BYTES}", doc="those that are to be in, as in elbow.pd, by spaces"
    )


class ModifiedAnswer(Status, version=1, message="modified"):
    """A board's answer: which message it has obeyed, or why it could not."""


class ModifierStatus(AnsweringStatus, version=1):
    """Status of the board that puts in modifications."""


BoardAndName = Annotated[
    str,
    StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_-]*$", max_length=NAME_BYTES - 1),
]


class SenderParams(Table):
    """`[board.<name>.params]`: what an operator may put in."""

    known: tuple[BoardAndName, ...] = Field(min_length=1, max_length=MOST_NAMES)
    """modifications as board.name, of boards of the other rack"""


class ModificationSender(Executor):
    """Sends an operator's modifications to boards of another rack; done is what all have answered.

    A restarted board gets all of its operator's commands again, in order, and comes to the same.
    """

    modified = Inputs(ModifiedAnswer, "lan.modified")
    operator = Input(OperatorCommand, "own.operator")
    command = Output(Modifications)
    status = Output(ModifierStatus)
    commands = {Operation.MODIFY: (Goal.ON, Goal.OFF)}
    params = SenderParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._known = read_params(SenderParams, context.params).known
        self._wanted: set[str] = set()
        self._orders = Orders(self.commands)
        self._pending: list[int] = []  # serials of commands that not all boards have answered

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the modifications."""
        found = params.get("known")
        return tuple(map(str, found)) if isinstance(found, Sequence) else ()

    def process(self, tick: int) -> None:
        """Send what is to be in, and report whether it is."""
        self._orders.take(self.operator, judge=self._obey)
        self.command.id = self._orders.serial
        self.command.wanted = " ".join(sorted(self._wanted))
        answers = self.modified.values()
        status = self.status
        reasons = [answer.message.reason for answer in answers if answer.message.error]
        silent = [box for box, answer in self.modified.items() if answer.is_lost]
        if not reasons and all(answer.message.echo == self._orders.serial for answer in answers):
            for serial in self._pending:
                self._orders.drives_done(serial)
            self._pending.clear()
        status.echo = self._orders.serial
        status.reason = "; ".join([*reasons, *(f"no answer in {box}" for box in silent)])
        status.state = State.EXECUTING if self._pending else State.IDLE
        if status.reason:
            status.state = State.HOLDING
        self._orders.report(status)

    def _obey(self, command: OperatorCommand) -> None:
        if command.name not in self._known:
            self._orders.refuse(
                f"no modification '{command.name}'; permitted: {', '.join(self._known)}"
            )
            return
        (self._wanted.add if command.goal == Goal.ON else self._wanted.discard)(command.name)
        self._orders.takes_time()
        self._pending.append(self._orders.serial)


class ModifiedFromAfar(JointServo):
    """Servoes joints by a law that another rack, and an operator here, may modify."""

    asked = Input(Modifications, "lan.modifications")
    modified = Output(ModifiedAnswer, cycles=ANSWER_CYCLES)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._asked: set[str] = set()  # own modifications that are to be in

    def process(self, tick: int) -> None:
        """Modify the law as asked, and go on."""
        if self.asked.is_new:
            own = f"{self.context.board}."
            wanted = {
                name.removeprefix(own)
                for name in self.asked.message.wanted.split()
                if name.startswith(own)
            }
            refused = {
                name: why
                for name in sorted(wanted ^ self._asked)
                if (why := self._modified.switch(name, name in wanted))
            }
            # Those refused are asked for in every message, and each answer says so.
            self._asked = wanted.difference(refused)
            self.modified.echo = self.asked.message.id
            self.modified.error = len(refused)
            self.modified.reason = "; ".join(refused.values())
        super().process(tick)
