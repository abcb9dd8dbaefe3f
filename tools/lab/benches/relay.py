"""The emptiest boards: one sends a message in every cycle, each of the others passes it on."""

from __future__ import annotations

from rack.backplane.message import State, Status, field
from rack.levels.level import Executor, Input, Ports


class Relayed(Status, version=1):
    """A message that is passed on from board to board."""

    sent: int = field(unit="tick", doc="cycle in which the first board sent this message")


class Sender(Executor):
    """Sends a message in every cycle."""

    outputs = {"status": Relayed}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Send."""
        write.status.state = State.EXECUTING
        write.status.sent = tick


class Relay(Executor):
    """Passes on the message of another board, which the config wires to `message`."""

    inputs = {"message": Input(Relayed, "own.status")}
    outputs = {"status": Relayed}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Pass it on; -1 while there is none."""
        write.status.state = State.EXECUTING
        write.status.sent = read.message.value.sent if read.message.is_there else -1
