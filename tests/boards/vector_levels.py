"""Levels for tests of boards with several neighbours: a board a joint between one level above and
one below.

Each joint takes its own part of the vector that the level above commands, and the level below adds
the parts up.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field as Key

from rack.backplane.message import Command, State, field
from rack.levels.level import Executor, Input, Inputs, LevelContext, Output
from rack.levels.operator import RESTS_ON, AnsweringStatus, Operation, OperatorCommand, Orders
from rack.levels.tables import Table, read_params

JOINTS = 3


class TestPath(Command, version=1):
    operator: int = RESTS_ON
    position: np.ndarray = field(unit="1", doc="of every joint", shape=JOINTS)


class TestPart(Command, version=1):
    operator: int = RESTS_ON
    position: np.ndarray = field(unit="1", doc="of this board's joint; others 0", shape=JOINTS)


class TestSeen(AnsweringStatus, version=1):
    position: np.ndarray = field(unit="1", doc="", shape=JOINTS)
    lost: np.ndarray = field("u1", unit="1", doc="", shape=JOINTS)


class PathLevel(Executor):
    """Commands all joints at once; reads a status of each."""

    operator = Input(OperatorCommand, "own.operator")
    joints = Inputs(TestSeen, "below.status")
    command = Output(TestPath)
    status = Output(TestSeen, rests_on=joints)
    commands = {Operation.HOLD: (), Operation.RESUME: ()}

    def self_test(self) -> None:
        self.orders = Orders(self.commands)

    def process(self, tick: int) -> None:
        """Move on, unless held; show what the joints report, and which of them are lost."""
        self.orders.take_commands(self.operator)
        if self.orders.standing is not Operation.HOLD:
            self.command.position[:] = [tick, 2 * tick, 3 * tick]
        self.command.operator = self.orders.find_basis(0)
        for at, joint in enumerate(self.joints.values()):
            self.status.position[at] = joint.message.position[at]
            self.status.lost[at] = joint.is_lost
        self.orders.report_done()
        self.orders.fill_status(self.status)
        self.status.state = State.EXECUTING


class JointParams(Table):
    """`[board.<joint>.params]`."""

    joint: int = Key(ge=0, lt=JOINTS, description="row of the joint in the vector")


class JointLevel(Executor):
    """Takes its joint's part of the command; shows what the level below has made of it."""

    above = Input(TestPath, "above.command")
    below = Input(TestSeen, "below.status")
    part = Output(TestPart, rests_on=above)
    status = Output(TestSeen, rests_on=below)
    params = JointParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._joint = read_params(JointParams, context.params).joint

    def process(self, tick: int) -> None:
        """Pass the part on, and the status back."""
        self.part.position[self._joint] = self.above.message.position[self._joint]
        self.part.operator = self.above.message.operator
        self.status.position[:] = self.below.message.position
        self.status.operator = self.below.message.operator
        self.status.state = State.EXECUTING


class ArmLevel(Executor):
    """Adds the parts of all joints up."""

    parts = Inputs(TestPart, "above.part")
    status = Output(TestSeen)

    def process(self, tick: int) -> None:
        """Show the whole vector, and which of its boards are lost."""
        parts = list(self.parts.values())
        self.status.position[:] = sum(part.message.position for part in parts)
        self.status.lost[:] = [part.is_lost for part in parts]
        self.status.operator = min(part.message.operator for part in parts)
        self.status.state = State.EXECUTING


class Misled(JointLevel):
    """Names an input that it does not have."""

    part = Output(TestPart, rests_on=ArmLevel.parts)
