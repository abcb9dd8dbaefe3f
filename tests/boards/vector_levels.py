"""Levels for tests of boards with several neighbours: a board a joint between one level above and
one below.

Each joint takes its own part of the vector that the level above commands, and the level below adds
the parts up.
"""

from __future__ import annotations

from pydantic import Field as Key

from rack.backplane.message import Field, State, command, status
from rack.levels.level import Executor, Input, LevelContext, Output, Ports
from rack.levels.operator import ANSWER, OPERATOR_COMMAND, RESTS_ON, Operation, Orders
from rack.levels.tables import Table, read_params

JOINTS = 3
PATH = command("test_path", 1, RESTS_ON, Field("position", "f8", "1", "of every joint", (JOINTS,)))
PART = command(
    "test_part",
    1,
    RESTS_ON,
    Field("position", "f8", "1", "of this board's joint; others 0", (JOINTS,)),
)
SEEN = status(
    "test_seen",
    1,
    *ANSWER,
    Field("position", "f8", "1", "", (JOINTS,)),
    Field("lost", "u1", "1", "", (JOINTS,)),
)


class PathLevel(Executor):
    """Commands all joints at once; reads a status of each."""

    inputs = {
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
        "joints": Input(SEEN, "below.status", many=True),
    }
    outputs = {"command": PATH, "status": Output(SEEN, rests_on="joints")}
    commands = {Operation.HOLD: (), Operation.RESUME: ()}

    def self_test(self) -> None:
        self.orders = Orders(self.commands)

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Move on, unless held; show what the joints report, and which of them are lost."""
        self.orders.take(read.operator)
        if self.orders.standing is not Operation.HOLD:
            write.command.position[:] = [tick, 2 * tick, 3 * tick]
        write.command.operator = self.orders.rests_on(0)
        for at, joint in enumerate(read.joints.values()):
            write.status.position[at] = joint.value.position[at]
            write.status.lost[at] = joint.is_lost
        self.orders.done()
        self.orders.report(write.status)
        write.status.state = State.EXECUTING


class JointParams(Table):
    """`[board.<joint>.params]`."""

    joint: int = Key(ge=0, lt=JOINTS, description="row of the joint in the vector")


class JointLevel(Executor):
    """Takes its joint's part of the command; shows what the level below has made of it."""

    inputs = {"command": Input(PATH, "above.command"), "below": Input(SEEN, "below.status")}
    outputs = {"part": Output(PART, rests_on="command"), "status": Output(SEEN, rests_on="below")}
    params = JointParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._joint = read_params(JointParams, context.params).joint

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Pass the part on, and the status back."""
        write.part.position[self._joint] = read.command.value.position[self._joint]
        write.part.operator = read.command.value.operator
        write.status.position[:] = read.below.value.position
        write.status.operator = read.below.value.operator
        write.status.state = State.EXECUTING


class ArmLevel(Executor):
    """Adds the parts of all joints up."""

    inputs = {"parts": Input(PART, "above.part", many=True)}
    outputs = {"status": SEEN}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Show the whole vector, and which of its boards are lost."""
        parts = list(read.parts.values())
        write.status.position[:] = sum(part.value.position for part in parts)
        write.status.lost[:] = [part.is_lost for part in parts]
        write.status.operator = min(part.value.operator for part in parts)
        write.status.state = State.EXECUTING


class Misled(JointLevel):
    """Names an input that it does not have."""

    outputs = {**JointLevel.outputs, "part": Output(PART, rests_on="comand")}


class Lone(Executor):
    """A board without neighbours."""

    outputs = {"status": SEEN}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Report nothing."""
