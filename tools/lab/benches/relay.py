"""The emptiest boards: one sends a message in every cycle, each of the others passes it on."""

from __future__ import annotations

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output


class Relayed(Status, version=1):
    """A message that is passed on from board to board."""

    sent: int = field(unit="tick", doc="cycle in which the first board sent this message")


class FirstBoard(Executor):
    """Sends a message in every cycle."""

    status = Output(Relayed)

    def process(self, tick: int) -> None:
        """Send."""
        self.status.state = State.EXECUTING
        self.status.sent = tick


class Relay(Executor):
    """Passes on the message of another board, which the config wires to `message`."""

    message = Input(Relayed, "own.status")
    status = Output(Relayed)

    def process(self, tick: int) -> None:
        """Pass it on; -1 while there is none."""
        self.status.state = State.EXECUTING
        self.status.sent = self.message.message.sent if self.message.is_there else -1
