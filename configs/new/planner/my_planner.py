"""A planner to start from. It runs in the background of a level, and may take longer than a cycle.

The executor reads the newest plan in every cycle. A plan takes effect `within_cycles` cycles after
it was begun. `rack.levels.level` documents what else a level must do.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message, State, Status, field
from rack.levels import Executor, Input, LevelContext, Output, Planner
from rack.levels.messages import ServoStatus
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics


class MyPlannerPlan(Message, version=1):
    """Message from the planner to the executor. Raise its version when the fields change."""

    gravity: np.ndarray = field(unit="N m", shape="joints", doc="torques that hold the arm still")


class MyPlannerStatus(Status, version=1):
    """Message that the level writes in every cycle."""

    moving: float = field(unit="N m", doc="largest torque that is spent on motion")


class MyPlannerLevel(Executor):
    """Shows how much torque moves the arm, in addition to the torque that holds it."""

    servo = Input(ServoStatus, "servo.status")
    plan = Input(MyPlannerPlan, "own.plan")
    status = Output(MyPlannerStatus)

    def process(self, tick: int) -> None:
        """Run one cycle: read the inputs and the newest plan, and fill the outputs."""
        self.status.state = State.EXECUTING
        if self.plan.has_message:
            spent = self.servo.message.torque - self.plan.message.gravity
            self.status.moving = float(abs(spent).max())


class MyPlanner(Planner):
    """Computes the torques of gravity from a model of the arm."""

    servo = Input(ServoStatus, "servo.status")
    output = Output(MyPlannerPlan)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self.dynamics = Dynamics(cell)
        self.rest = np.zeros(len(cell.home))  # (joints,), rad/s

    def wanted(self, tick: int) -> bool:
        """Return whether there is new input for a plan. The base class checks the port `above`."""
        return self.servo.is_new

    def plan(self, tick: int) -> None:
        """Compute one plan."""
        position = self.servo.message.position
        self.output.gravity[:] = self.dynamics.terms(position, self.rest).bias
