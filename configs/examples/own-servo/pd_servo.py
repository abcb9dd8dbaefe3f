"""A servo level of one's own: PD control with gravity compensation, in place of computed torque."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import State
from rack.levels.arm import SimulatedArm
from rack.levels.level import Executor, Input, LevelContext, Output
from rack.levels.messages import ArmState, JointCommand, Scene, ServoPlan, ServoStatus
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics, Payload
from rack.levels.servo.control import Grip
from rack.levels.tables import Positive, Table, read_params


class Gains(Table):
    """What `[board.servo.params]` may hold."""

    stiffness: Positive = 1600.0
    """acceleration for an error of one rad, 1/s2"""
    damping: Positive = 80.0
    """acceleration against an error of one rad/s, 1/s"""


class PdServo(Executor):
    """Drives every joint towards its newest set point; gains are scaled by the inertia of each
    joint."""

    above = Input(JointCommand, "above.command")
    plan = Input(ServoPlan, "own.plan")
    before = Input(ArmState, "own.state")
    status = Output(ServoStatus)
    state = Output(ArmState)
    scene = Output(Scene)
    params = Gains

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.gains = read_params(Gains, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self.arm = SimulatedArm(cell, context.scene, context.clock_ns, context.every, context.seed)
        self.grip = None if context.robot.gripper is None else Grip(context.robot.gripper)
        self.dynamics = Dynamics(cell)
        self.rest = np.zeros(len(cell.home))  # (joints,), rad/s
        self.target = cell.home  # (joints,), rad
        self.target_velocity = self.rest  # rad/s

    def process(self, tick: int) -> None:
        """Let the arm's time pass to `tick`, sense, drive, report."""
        if self.arm.tick == 0 and self.before.is_there:
            self.arm.restore(self.before.message)  # the board was restarted
        self.arm.step(tick - self.arm.tick)
        sensed = self.arm.sense()
        command = self.above.message
        holding = not command.due or tick > command.due + 4 * self.context.every
        if not holding:
            ahead_s = (tick - command.due) * self.context.tick_s
            self.target = command.position + ahead_s * command.velocity
            self.target_velocity = command.velocity
        error = self.target - sensed.position
        slip = self.target_velocity - sensed.velocity
        load = Payload(self.plan.message.payload_mass, self.plan.message.payload_offset)
        inertia, gravity = self.dynamics.terms(sensed.position, self.rest, load)
        torque = (
            inertia.diagonal() * (self.gains.stiffness * error + self.gains.damping * slip)
            + gravity
        )
        if self.grip is not None and self.above.is_new:
            self.grip.take(command)
        force = (
            0.0 if self.grip is None else self.grip.force(sensed.opening, sensed.opening_velocity)
        )
        self.arm.drive(torque, force)
        status = self.status
        status.echo = command.id
        status.operator = command.operator
        status.state = State.IDLE if holding else State.EXECUTING
        status.holding = holding  # the level above begins to move when it has seen the arm hold
        status.position = sensed.position
        status.velocity = sensed.velocity
        status.torque = self.arm.torque
        status.target = self.target
        status.target_velocity = self.rest if holding else self.target_velocity
        status.opening = sensed.opening
        status.opening_velocity = sensed.opening_velocity
        self.arm.save(self.state)
        self.arm.look(self.scene)
