"""Control loops of the servo level: torques of the joints, and the force of the gripper."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, field_validator

from rack.levels.algebra import Array
from rack.levels.arm import JointTarget, find_arm
from rack.levels.compiled import compiled_for
from rack.levels.messages import ArmSetPoint
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED
from rack.levels.servo.curves import Motion
from rack.levels.servo.modification import ModifiableParams
from rack.levels.tables import GripperConfig, Live, Positive, Table

Reacting = Literal["hold", "stop", "brake"]


class LoopGains(Table):
    """Gains of the joint loop."""

    bandwidth: Live[Positive] = Field(60.0, le=400.0)
    """natural frequency of the error in every joint [rad/s]"""
    damping: Live[Positive] = Field(1.0, le=3.0)
    """damping ratio of the error"""

    def fill_constants(self, table: Array) -> None:
        """Write stiffness in 1/s2 and damping in 1/s to the first two rows of a law's constants."""
        table[0] = self.bandwidth**2
        table[1] = 2.0 * self.damping * self.bandwidth


class ArmParams(Table):
    """The class of the arm that a board drives, and the reactions to sensor and motor faults."""

    following: Positive = 0.02
    """distance of a joint from its set point at which a motor counts as failed [rad]"""
    on_sensor_fault: Reacting = "brake"
    """ramp to rest and hold, or ramp and brake, or brake; without known velocities always brake"""
    on_actuator_fault: Reacting = "brake"
    """ramp to rest and hold, or ramp and brake, or brake"""
    good_cycles: int = Field(20, ge=1, le=10_000)
    """consecutive good cycles after which a fault is over"""
    retry: Positive = 0.5
    """time after which a motor that gave too little is retried, or a struck arm resumes [s]"""
    patience: Positive = 5.0
    """time for which faults may keep the arm from its set points before they are latched [s]"""
    arm: str = "rack.levels.arm:SimulatedArm"
    """class of the arm, package.module:Class; see rack.levels.arm.Arm"""

    @field_validator("arm")
    @classmethod
    def _check_arm(cls, reference: str) -> str:
        """Check that the class can be loaded and is an arm class."""
        find_arm(reference)
        return reference


class LawParams(ModifiableParams, ArmParams):
    """`[board.servo.params]` of any servo law; your own law adds its keys in a subclass."""


class ServoParams(LawParams, LoopGains):
    """`[board.servo.params]`: the arm, gains of the joint loop, and the reactions to faults."""


@compiled_for("f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1]")
def set_torque(
    table: Array,  # (4, joints): rows as below
    wanted: Array,  # (3, joints): rad, rad/s, rad/s2
    state: Array,  # (2, joints): rad, rad/s
    inertia: Array,  # (joints, joints), kg m2
    bias: Array,  # (joints,), N m
) -> None:
    """Set the torques of `ServoExecutor` in the last row of `table`.

    Args:
        table: Stiffness, damping, dry friction and, as output, torques.
        wanted: Positions, velocities and accelerations to follow.
        state: Sensed positions and velocities.
        inertia: Inertia that accelerates the joints.
        bias: Torques of gravity and velocities.
    """
    # In 1/s2, 1/s, N m and N m. The torques are the output.
    stiffness, damping, dry, torque = table
    for j in range(len(torque)):
        torque[j] = bias[j] + dry[j] * math.tanh(wanted[1, j] / FRICTION_SPEED)
    for k in range(len(torque)):
        damped = wanted[2, k] + damping[k] * (wanted[1, k] - state[1, k])
        acceleration = damped + stiffness[k] * (wanted[0, k] - state[0, k])
        for j in range(len(torque)):
            torque[j] += inertia[j, k] * acceleration


@compiled_for("f8[::1], f8[::1]")
def limit_torques(torque: Array, limits: Array) -> bool:
    """Limit torques in place. NaN is not changed.

    Args:
        torque: Torques, (joints,), N m.
        limits: Torque limits, (joints,), N m.

    Returns:
        True if a torque was limited.
    """
    cut = False
    for j in range(len(torque)):
        if abs(torque[j]) > limits[j]:
            torque[j] = math.copysign(limits[j], torque[j])
            cut = True
    return cut


class SetPointLaw:
    """Computes set points for drives that close a position or velocity loop.

    A set point is the motion wanted at the end of the cycle. Velocity drives do not control the
    position, so their set point also contains a term that corrects the position error, as fast as
    `ServoExecutor` would by torques.
    """

    def __init__(self, cell: Cell, params: LoopGains, period_s: float) -> None:
        self._period_s = period_s
        self._is_velocity = cell.interface == "velocity"
        self.set_gains(params)

    def set_gains(self, gains: LoopGains) -> None:
        """Replace the gains."""
        self._gain = 0.5 * gains.bandwidth / gains.damping if self._is_velocity else 0.0  # 1/s

    def compute_target(self, wanted: Motion, position: Array, torque: Array) -> JointTarget:
        """Return the set points for the end of this cycle.

        Args:
            wanted: Motion to follow.
            position: Sensed positions, (joints,), rad.
            torque: Predicted torques, (joints,), N m, which are passed on to the drives.
        """
        gained = self._period_s * wanted.acceleration
        return JointTarget(
            wanted.position + self._period_s * (wanted.velocity + 0.5 * gained),
            wanted.velocity + gained + self._gain * (wanted.position - position),
            torque,
        )


class Grip:
    """Computes the force of the gripper, in N or N m.

    A spring and a damper pull the gripper to the commanded opening, with at most the commanded
    force. Before the first set point the gripper opens or, after `keep_force`, applies a constant
    force.
    """

    def __init__(self, config: GripperConfig) -> None:
        self._stiffness, self._damping = config.gains
        self._most_force = config.force
        self._least, self._most = sorted((config.open, config.closed))
        self._opening = config.open
        self._limit = config.force
        self._constant_force: float | None = None

    def keep_force(self, force: float) -> None:
        """Apply a constant force until the first set point.

        A held object must not be dropped when the board restarts.

        Args:
            force: Force, N or N m.
        """
        self._constant_force = force

    def take_command(self, command: ArmSetPoint) -> None:
        """Adopt opening and force of a valid set point, limited to the range of the gripper."""
        if command.due != 0 and math.isfinite(command.opening) and math.isfinite(command.force):
            self._opening = min(max(command.opening, self._least), self._most)
            self._limit = min(max(command.force, 0.0), self._most_force)
            self._constant_force = None

    def compute_force(self, opening: float, velocity: float) -> float:
        """Return the force of the gripper, in N or N m.

        Args:
            opening: Sensed opening, m or rad.
            velocity: Rate of the opening, m/s or rad/s.
        """
        if self._constant_force is not None:
            return self._constant_force
        force = self._stiffness * (self._opening - opening) - self._damping * velocity
        return min(max(force, -self._limit), self._limit)
