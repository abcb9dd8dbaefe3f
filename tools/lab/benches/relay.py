"""The emptiest boards: one sends a message in every cycle, each of the others passes it on."""

from __future__ import annotations

from rack.backplane.message import Field, State, status
from rack.levels.level import Executor, Input, Ports

RELAYED = status(
    "relayed", 1, Field("sent", "i8", "tick", "cycle in which the first board sent this message")
)


class Sender(Executor):
    """Sends a message in every cycle."""

    outputs = {"status": RELAYED}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Send."""
        write.status.state = State.EXECUTING
        write.status.sent = tick


class Relay(Executor):
    """Passes on the message of another board, which the config wires to `message`."""

    inputs = {"message": Input(RELAYED, "own.status")}
    outputs = {"status": RELAYED}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Pass it on; -1 while there is none."""
        write.status.state = State.EXECUTING
        write.status.sent = read.message.value.sent if read.message.is_there else -1
