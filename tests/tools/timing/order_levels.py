"""Levels that pass an order on, for tests of responses across racks."""

from __future__ import annotations

from rack.backplane.message import Command, Status, field
from rack.levels.level import Executor, Input, Output


class Order(Command, version=1):
    """The tick at which the source gave it."""

    given: int = field(unit="tick", doc="tick of the source")


class Obeyed(Status, version=1):
    """The newest order."""

    given: int = field(unit="tick", doc="tick of the source")


class Source(Executor):
    """Gives an order in each cycle."""

    command = Output(Order)

    def process(self, tick: int) -> None:
        self.command.given = tick


class Relay(Executor):
    """Passes orders on."""

    above = Input(Order, "above.command")
    command = Output(Order, rests_on=above)

    def process(self, tick: int) -> None:
        self.command.given = self.above.message.given


class Sink(Executor):
    """Takes orders."""

    above = Input(Order, "above.command")
    status = Output(Obeyed, rests_on=above)

    def process(self, tick: int) -> None:
        self.status.given = self.above.message.given
