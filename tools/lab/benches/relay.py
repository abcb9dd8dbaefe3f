"""Minimal boards that pass a message along a chain."""

from __future__ import annotations

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Output


class Relayed(Status, version=1):
    """Message that is passed from board to board."""

    sent: int = field(unit="tick", doc="cycle in which the first board sent this message")


class FirstBoard(Executor):
    """Executor that sends a new message in every cycle."""

    status = Output(Relayed)

    def process(self, tick: int) -> None:
        """Send a message that contains the tick of this cycle."""
        self.status.state = State.EXECUTING
        self.status.sent = tick


class Relay(Executor):
    """Executor that passes on the message of another board, wired to `message` in the config."""

    message = Input(Relayed, "own.status")
    status = Output(Relayed)

    def process(self, tick: int) -> None:
        """Pass on the tick in the newest message. Sends -1 until the first message is received."""
        self.status.state = State.EXECUTING
        self.status.sent = self.message.message.sent if self.message.has_message else -1
