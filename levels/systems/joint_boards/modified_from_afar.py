"""Control modifications that another rack switches in servo laws over a network.

The message contains the modifications that must be active, not what has changed, so a message that
is lost or overtaken does no harm. While the other rack is lost, modifications stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from rack.backplane.message import Command, State, Status, field
from rack.levels.level import OPERATOR, Executor, Input, Inputs, LevelContext, Output
from rack.levels.operator import AnsweringStatus, Goal, Operation, OperatorCommand
from rack.levels.systems.joint_boards.joint_servo import JointServo
from rack.levels.tables import Table

NAME_BYTES = 40
"""Length of a name in a message, including a space."""
MOST_NAMES = 8
"""Maximum number of names in a message."""
ANSWER_CYCLES = 20
"""Cycles of a joint's board from answer to answer, which at 1 kHz suits a network."""


class Modifications(Command, version=1):
    """The control modifications that must be active."""

    wanted: str = field(
        f"S{MOST_NAMES * NAME_BYTES}",
        doc="modifications that must be active, such as elbow.pd, separated by spaces",
    )


class ModifiedAnswer(Status, version=1, message="modified"):
    """A board's answer: the message that it has obeyed, or why it could not."""


class ModifierStatus(AnsweringStatus, version=1):
    """Status of the board that sends modifications."""


BoardAndName = Annotated[
    str,
    StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_-]*$", max_length=NAME_BYTES - 1),
]


class SenderParams(Table):
    """`[board.<name>.params]`: the modifications that an operator may switch."""

    known: tuple[BoardAndName, ...] = Field(min_length=1, max_length=MOST_NAMES)
    """modifications as board.name, of boards of the other rack"""


class ModificationSender(Executor):
    """Sends an operator's modifications to boards of another rack.

    A command is done when all boards have answered. After a restart the sending board receives all
    commands of its operator again, in order, and so restores its state.
    """

    modified = Inputs(ModifiedAnswer, "lan.modified")
    operator = OPERATOR
    command = Output(Modifications)
    status = Output(ModifierStatus)
    commands = {Operation.MODIFY: (Goal.ON, Goal.OFF)}
    params = SenderParams
    settings: SenderParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._known = self.settings.known
        self._wanted: set[str] = set()
        self._pending: list[int] = []  # serials of commands that not all boards have answered

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the modifications."""
        known = params.get("known")
        return tuple(map(str, known)) if isinstance(known, Sequence) else ()

    def process(self, tick: int) -> None:
        """Send the modifications that must be active, and report whether they are."""
        self._orders.take_commands(self.operator, judge=self._obey_command)
        self.command.id = self._orders.serial
        self.command.wanted = " ".join(sorted(self._wanted))
        answers = self.modified.values()
        status = self.status
        reasons = [answer.message.reason for answer in answers if answer.message.error]
        silent = [box for box, answer in self.modified.items() if answer.is_lost]
        if not reasons and all(answer.message.echo == self._orders.serial for answer in answers):
            for serial in self._pending:
                self._orders.report_completed(serial)
            self._pending.clear()
        status.echo = self._orders.serial
        status.reason = "; ".join([*reasons, *(f"no answer in {box}" for box in silent)])
        status.state = State.EXECUTING if self._pending else State.IDLE
        if status.reason:
            status.state = State.HOLDING
        self._orders.fill_status(status)

    def _obey_command(self, command: OperatorCommand) -> None:
        """Switch a modification, or refuse a name that is not known."""
        if command.name not in self._known:
            self._orders.refuse_newest(
                f"no modification '{command.name}'; permitted: {', '.join(self._known)}"
            )
            return
        (self._wanted.add if command.goal == Goal.ON else self._wanted.discard)(command.name)
        self._orders.report_setting_started()
        self._pending.append(self._orders.serial)


class ModifiedFromAfar(JointServo):
    """Controls joints by a law that another rack, and an operator of this rack, can modify."""

    asked = Input(Modifications, "lan.modifications")
    modified = Output(ModifiedAnswer, cycles=ANSWER_CYCLES)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._requested: set[str] = set()  # modifications of this board that must be active

    def process(self, tick: int) -> None:
        """Switch modifications as the other rack requests, then run the cycle."""
        if self.asked.is_new:
            prefix = f"{self.context.board}."
            wanted = {
                name.removeprefix(prefix)
                for name in self.asked.message.wanted.split()
                if name.startswith(prefix)
            }
            refused = {
                name: refusal
                for name in sorted(wanted ^ self._requested)
                if (refusal := self._modified.switch_modification(name, name in wanted))
            }
            # A refused modification is tried again with every message, so that every answer reports
            # the refusal.
            self._requested = wanted.difference(refused)
            self.modified.echo = self.asked.message.id
            self.modified.error = len(refused)
            self.modified.reason = "; ".join(refused.values())
        super().process(tick)
