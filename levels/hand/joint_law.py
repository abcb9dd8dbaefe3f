"""The law of the joints: torques that make every joint's error that of a damped oscillator, as stiff as is wanted.

torque = M(q) (2 d w (qd_wanted - qd) + s w^2 (q_wanted - q)) + weight(q) + friction(qd_wanted) + torque of tip forces

`s`, 0 to 1 a joint, is the part of the stiffness that acts; the damping always acts, so a finger that only exerts a
force is still slow. The weight of a finger is small, but at a joint that is soft it would cost degrees. Viscous friction
is fed forward for the velocity that is wanted, not for the one sensed: what damps is not cancelled. The sample is taken
on to when the torque acts, a valve's lag included, at the velocity sensed.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.compiled import compiled
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Dynamics
from rack.levels.tables import NotNegative, Positive, Table


class JointGains(Table):
    """Gains of the joint loop."""

    bandwidth: Positive = Field(40.0, le=400.0, description="natural frequency of the error in every joint, rad/s")
    damping: Positive = Field(1.0, le=5.0, description="damping ratio of the error at whole stiffness")
    ahead: NotNegative = Field(0.006, le=0.1, description="time from a command of tensions until they have come, s")


class JointLaw:
    """Sets the torques of some joints of a hand."""

    def __init__(self, cell: Cell, driven: Array, gains: JointGains) -> None:
        """Drive the joints whose `driven`, (joints,), is 1."""
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(len(driven))
        self._constants = np.zeros((4, len(driven)))  # in the rows of `set_joint_torques`
        self._constants[:] = self._dynamics.dry, cell.model.dof_damping[cell.dof], cell.bounds.torque, driven
        self._gains = gains.bandwidth**2, 2.0 * gains.damping * gains.bandwidth
        self._ahead = gains.ahead
        self._set = set_joint_torques.load()
        self.clipped = 0  # cycles in which a torque was cut to what the tendons can give

    def torques(self, hand: Message, age_s: float, target: Message, ahead_s: float, out: Array) -> None:
        """Set `out`, (joints,), N m, from a `HAND_STATUS` and a `FINGER_TARGET`.

        The sample is `age_s` old when the torque is commanded; the target is to be taken on by `ahead_s`.
        """
        position, velocity = hand.position, hand.velocity
        terms = self._dynamics.terms(position, self._still)
        times = age_s + self._ahead, ahead_s
        wanted = target.position, target.velocity, target.stiff, target.torque
        if self._set(self._gains, times, self._constants, position, velocity, *wanted, terms.inertia, terms.bias, out):
            self.clipped += 1


@compiled
def set_joint_torques(
    gains: tuple[float, float],  # stiffness, 1/s2, and damping, 1/s
    times: tuple[float, float],  # s: by which the sample, and the target, are taken on
    constants: Array,  # (4, joints): rows as below
    position: Array,  # (joints,), rad
    velocity: Array,  # (joints,), rad/s
    target: Array,  # (joints,), rad
    target_velocity: Array,  # (joints,), rad/s
    stiff: Array,  # (joints,): part of the stiffness
    added: Array,  # (joints,), N m
    inertia: Array,  # (joints, joints), kg m2
    weight: Array,  # (joints,), N m
    torque: Array,  # (joints,), N m: set; 0 for joints of other boards
) -> bool:
    """Set the torques; return whether a limit cut one."""
    dry, viscous, limit, driven = constants[0], constants[1], constants[2], constants[3]  # N m, N m s/rad, N m, 1
    joints, clipped = len(torque), False
    for j in range(joints):
        torque[j] = 0.0
        if driven[j] != 0.0:
            friction = viscous[j] * target_velocity[j] + dry[j] * math.tanh(target_velocity[j] / FRICTION_SPEED)
            torque[j] = weight[j] + added[j] + friction
    for k in range(joints):
        if driven[k] == 0.0:
            continue
        away = target[k] + times[1] * target_velocity[k] - position[k] - times[0] * velocity[k]
        acceleration = gains[0] * stiff[k] * away + gains[1] * (target_velocity[k] - velocity[k])
        for j in range(joints):
            if driven[j] != 0.0:
                torque[j] += inertia[j, k] * acceleration
    for j in range(joints):
        if driven[j] != 0.0:
            needed = torque[j]
            torque[j] = np.minimum(np.maximum(needed, -limit[j]), limit[j])  # NaN stays
            clipped = clipped or needed != torque[j]
    return clipped


def preload() -> None:
    """Load this module's compiled function."""
    joint, square = np.zeros(1), np.zeros((1, 1))
    set_joint_torques.load()((0.0,) * 2, (0.0,) * 2, np.zeros((4, 1)), *[joint] * 6, square, joint, joint)
