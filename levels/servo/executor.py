"""The executor of the servo level: one cycle of computed torque."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backplane.message import Message, State
from levels.arm import Arm, Sensed, SimulatedArm
from levels.cell import build_cell
from levels.dynamics import Dynamics, Payload
from levels.level import Executor, Input, LevelContext, Ports
from levels.messages import ARM_STATE, JOINT_SET_POINT, SCENE, SERVO_PLAN, SERVO_STATUS, Error
from levels.params import read_params
from levels.servo.curves import Motion
from levels.servo.grip import Grip
from levels.servo.params import ServoParams
from levels.servo.reference import Reference

Array = NDArray[np.float64]


class ServoExecutor(Executor):
    """Follows joint set points with torques, and lets the arm's time pass.

    torque = M (qdd + 2 d w (qd_wanted - qd) + w^2 (q_wanted - q)) + bias(q, qd) + dry friction; M is the planner's.
    A cycle first simulates the ticks since the last one: the arm's time is the clock's also when cycles are missed.
    """

    inputs = {
        "command": Input(JOINT_SET_POINT, "above.command"),
        "plan": Input(SERVO_PLAN, "own.plan"),
        "before": Input(ARM_STATE, "own.state"),
    }
    outputs = {"status": SERVO_STATUS, "state": ARM_STATE, "scene": SCENE}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(ServoParams, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self.arm: Arm = SimulatedArm(cell, context.scene, context.clock_ns)
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self._dynamics = Dynamics(cell)
        self._grip = None if context.robot.gripper is None else Grip(context.robot.gripper)
        self._stiffness = params.bandwidth**2
        self._damping = 2.0 * params.damping * params.bandwidth
        self._started = False

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Let time pass to `tick`, sense, interpolate, drive; report."""
        missed = self._catch_up(read.before.value if read.before.is_there else None, tick)
        sensed = self.arm.sense()
        if missed:
            self.reference.meet(sensed.position, sensed.velocity, tick)
        command: Message = read.command.value
        wanted = self.reference.at(command, tick)
        torque = self._torque(wanted, sensed, read.plan.value if read.plan.is_there else None)
        grip_force = 0.0 if self._grip is None else self._grip.force(command, sensed.opening, sensed.opening_velocity)
        self.arm.drive(torque, grip_force)
        self._report(write.status, command, wanted, sensed)
        self.arm.save(write.state)
        self.arm.look(write.scene)

    def _catch_up(self, before: Message | None, tick: int) -> bool:
        """Simulate up to `tick`; return whether cycles were missed. A restarted board finds the arm as it was left."""
        if not self._started and before is not None:
            self.arm.restore(before)
            if self._grip is not None:
                self._grip.keep(self.arm.grip_force)
        ticks = tick - self.arm.tick
        self.arm.step(ticks)
        if not self._started:
            position, velocity, _, _ = self.arm.sense()
            self.reference.start(position, velocity, tick)
            self._started = True
            return False
        return ticks > self.context.every

    def _torque(self, wanted: Motion, sensed: Sensed, plan: Message | None) -> Array:
        """Return the torques, (joints,), N m, that lead to the motion wanted."""
        payload = None if plan is None else Payload(plan.payload_mass, plan.payload_offset)
        terms = self._dynamics.terms(sensed.position, sensed.velocity, payload)
        inertia = terms.inertia if plan is None else plan.inertia
        acceleration = (
            wanted.acceleration
            + self._damping * (wanted.velocity - sensed.velocity)
            + self._stiffness * (wanted.position - sensed.position)
        )
        return np.asarray(inertia @ acceleration + terms.bias + self._dynamics.friction(wanted.velocity))

    def _report(self, status: Message, command: Message, wanted: Motion, sensed: Sensed) -> None:
        arm, holding = self.arm, self.reference.holding
        status.echo = command.id
        status.position, status.velocity, status.torque = sensed.position, sensed.velocity, arm.torque
        status.target, status.target_velocity = wanted.position, wanted.velocity
        status.opening, status.opening_velocity = sensed.opening, sensed.opening_velocity
        status.grip_force = arm.grip_force
        status.holding = holding
        status.clipped = arm.clipped + self.reference.refused
        status.touches = arm.touches
        if arm.fault:
            status.state, status.error, status.reason = State.ERROR, Error.SIMULATION, arm.fault
            return
        status.state = State.IDLE if holding else State.EXECUTING
        if arm.touches and status.error == Error.NONE:
            status.error, status.reason = Error.TOUCHED, arm.first_touch
