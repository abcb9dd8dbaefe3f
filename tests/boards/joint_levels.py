"""A level above boards that servo joints: it moves every joint smoothly to and fro. And an arm
whose board stalls, and modifications of control."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import State
from rack.levels.level import Executor, Inputs, LevelContext, Output
from rack.levels.messages import PrimitiveStatus
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.servo.control import ArmParams
from rack.levels.servo.modification import Hook, LawSample, Modification
from rack.levels.systems.joint_boards import ArmExecutor
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.tables import read_params

AWAY_RAD = 0.15
"""Distance of every joint from home at the other end."""
LASTS_S = 0.4
"""Time from one end to the other."""


class Swing(Executor):
    """Moves all joints away from home and back by minimum-jerk motions; waits while a board below
    is stopped."""

    statuses = Inputs(JointStatus, "below.status")
    command = Output(JointReference)
    status = Output(PrimitiveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._dynamics = Dynamics(cell)
        self._from, self._to = cell.home.copy(), cell.home + AWAY_RAD
        self._next = cell.home.copy()
        self._begun: int | None = None  # tick; None: waiting
        self.opening = 0.04  # of the gripper, m

    def process(self, tick: int) -> None:
        """Write the set point due two cycles later."""
        command, due = self.command, tick + 2 * self.context.every
        readings = self.statuses.values()
        held = any(not one.has_message or one.is_lost or one.message.stopped for one in readings)
        self.status.state = State.HOLDING if held else State.EXECUTING
        self.status.reason = "a board below is stopped" if held else ""
        command.opening, command.force = self.opening, 20.0
        if held:
            self._begun, command.due = None, 0
            return
        if self._begun is None:
            self._begun, self._from = due, np.array(next(iter(readings)).message.position)
        elif (due - self._begun) * self.context.tick_s > LASTS_S:
            self._begun, self._from, self._to, self._next = due, self._to, self._next, self._to
        u, way = (due - self._begun) * self.context.tick_s / LASTS_S, self._to - self._from
        command.id += 1
        command.due = due
        command.position = self._from + way * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        command.velocity = way * 30.0 * u * u * (1.0 - u) ** 2 / LASTS_S
        command.acceleration = way * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / LASTS_S**2
        inertia, command.load = self._dynamics.terms(command.position, command.velocity)
        command.inertia = np.diagonal(inertia)


class StallingParams(ArmParams):
    """The last `stall` of every `period` cycles are missed."""

    stall: int
    period: int = 400


class StallingArm(ArmExecutor):
    """Drives the arm, but stalls again and again, as if the host took its core away."""

    params = StallingParams

    def __init__(self, context: LevelContext) -> None:
        self._given = read_params(StallingParams, context.params)
        super().__init__(context)

    def process(self, tick: int) -> None:
        """Drive the arm, unless it stalls: its messages are those of the last cycle then."""
        if tick % self._given.period < self._given.period - self._given.stall:
            super().process(tick)


class Lean(Modification):
    """Adds 4 N m to every joint."""

    hook = Hook.AFTER

    def modify(self, sample: LawSample) -> None:
        sample.torque += 4.0


class Breaks(Modification):
    """Fails in its 100th sample."""

    hook = Hook.BEFORE

    def begin(self, sample: LawSample) -> None:
        self.left = 100

    def modify(self, sample: LawSample) -> None:
        self.left -= 1
        if not self.left:
            sample.position[:] = np.nan
            raise KeyError("nothing left")
