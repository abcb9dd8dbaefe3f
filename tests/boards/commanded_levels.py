"""Two levels without an arm that take operator commands; their output depends on a command's
tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pydantic

from rack.backplane.message import Command, Message, State, field
from rack.levels.level import Executor, Input, Output
from rack.levels.operator import RESTS_ON, AnsweringStatus, Goal, Operation, OperatorCommand, Orders
from rack.levels.tables import Live, Table, read_params, set_live


class Step(Command, version=1):
    operator: int = RESTS_ON
    hold: bool = field(doc="1: hold")


class Counted(AnsweringStatus, version=1):
    count: int = field(unit="1", doc="cycles that were not held")


class Upper(Executor):
    """Passes an operator's hold down; refuses to go home."""

    operator = Input(OperatorCommand, "own.operator")
    below = Input(Counted, "below.status")
    command = Output(Step)
    status = Output(Counted, rests_on=below)
    commands = {Operation.HOLD: (), Operation.RESUME: (), Operation.GOTO: (Goal.HOME,)}

    def process(self, tick: int) -> None:
        orders = self.orders
        orders.take_commands(self.operator, self._judge)
        self.command.hold = orders.standing is Operation.HOLD
        self.command.operator = orders.find_basis(0)
        if self.below.message.operator >= orders.basis:
            orders.report_done()
        orders.fill_status(self.status)
        self.status.state = State.EXECUTING

    def _judge(self, command: Message) -> None:
        if self.orders.standing is Operation.GOTO:
            self.orders.refuse_newest("the way home is closed")

    def self_test(self) -> None:
        self.orders = Orders(self.commands)


class CountParams(Table):
    """Params of the lower level."""

    by: Live[int] = pydantic.Field(1, ge=1, le=9, description="counts in a cycle")
    label: str = ""


class Lower(Executor):
    """Counts, unless it is held from above or here; twice as fast while it is set to `twice`."""

    operator = Input(OperatorCommand, "own.operator")
    above = Input(Step, "above.command")
    status = Output(Counted)
    commands = {
        Operation.HOLD: (),
        Operation.RESUME: (),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
    }
    params = CountParams
    step = 1

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the one name."""
        return ("twice",)

    def process(self, tick: int) -> None:
        self.orders.take_commands(self.operator, self._set_parameter)
        held = bool(self.above.message.hold) or self.orders.standing is Operation.HOLD
        self.status.count += 0 if held else self.step * self.given.by
        if self.is_there:
            self.orders.report_done()
        self.orders.fill_status(self.status, self.above.message.operator)
        self.status.state = State.EXECUTING

    @property
    def is_there(self) -> bool:
        """Whether the command in force is done: at once."""
        return True

    def _set_parameter(self, command: Message) -> None:
        if command.what == Operation.MODIFY:
            self.step = 2 if command.goal == Goal.ON else 1
        elif command.what == Operation.SET:
            self.given, why = set_live(self.given, command.name)
            if why:
                self.orders.refuse_newest(why)

    def self_test(self) -> None:
        self.given = read_params(CountParams, self.context.params)
        self.orders = Orders(self.commands)


class Homing(Lower):
    """Goes home, too, which is done once it counts by nine."""

    commands = {**Lower.commands, Operation.GOTO: (Goal.HOME,)}

    @property
    def is_there(self) -> bool:
        """Whether the command in force is done."""
        return self.orders.standing is not Operation.GOTO or self.given.by == 9


class Plain(Executor):
    """Counts by a live parameter, which its board sets."""

    status = Output(Counted)
    params = CountParams
    settings: CountParams

    def process(self, tick: int) -> None:
        self.status.count += self.settings.by
        self.status.state = State.EXECUTING
