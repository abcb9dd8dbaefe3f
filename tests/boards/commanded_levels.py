"""Two levels without an arm that take operator commands; their output depends on a command's
tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pydantic

from rack.backplane.message import Field, Message, State, command, status
from rack.levels.level import Executor, Input, Ports
from rack.levels.operator import ANSWER, OPERATOR_COMMAND, RESTS_ON, Goal, Operation, Orders
from rack.levels.tables import LIVE, Table, read_params, set_live

STEP = command("step", 1, RESTS_ON, Field("hold", "u1", "1", "1: hold"))
COUNTED = status("counted", 1, *ANSWER, Field("count", "i8", "1", "cycles that were not held"))


class Upper(Executor):
    """Passes an operator's hold down; refuses to go home."""

    inputs = {
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
        "status": Input(COUNTED, "below.status"),
    }
    outputs = {"command": STEP, "status": COUNTED}
    commands = {Operation.HOLD: (), Operation.RESUME: (), Operation.GOTO: (Goal.HOME,)}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        orders = self.orders
        orders.take(read.operator, self._judge)
        write.command.hold = orders.standing is Operation.HOLD
        write.command.operator = orders.rests_on(0)
        if read.status.value.operator >= orders.basis:
            orders.done()
        orders.report(write.status)
        write.status.state = State.EXECUTING

    def _judge(self, command: Message) -> None:
        if self.orders.standing is Operation.GOTO:
            self.orders.refuse("the way home is closed")

    def self_test(self) -> None:
        self.orders = Orders(self.commands)


class CountParams(Table):
    """Params of the lower level."""

    by: int = pydantic.Field(1, ge=1, le=9, description="counts in a cycle", json_schema_extra=LIVE)
    label: str = ""


class Lower(Executor):
    """Counts, unless it is held from above or here; twice as fast while it is set to `twice`."""

    inputs = {
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
        "command": Input(STEP, "above.command"),
    }
    outputs = {"status": COUNTED}
    commands = {
        Operation.HOLD: (),
        Operation.RESUME: (),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
    }
    params = CountParams
    step = 1

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the one name."""
        return ("twice",)

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        self.orders.take(read.operator, self._set)
        held = bool(read.command.value.hold) or self.orders.standing is Operation.HOLD
        write.status.count += 0 if held else self.step * self.given.by
        if self.is_there:
            self.orders.done()
        self.orders.report(write.status, read.command.value.operator)
        write.status.state = State.EXECUTING

    @property
    def is_there(self) -> bool:
        """Whether the command in force is done: at once."""
        return True

    def _set(self, command: Message) -> None:
        if command.what == Operation.MODIFY:
            self.step = 2 if command.goal == Goal.ON else 1
        elif command.what == Operation.SET:
            self.given, why = set_live(self.given, command.name)
            if why:
                self.orders.refuse(why)

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
