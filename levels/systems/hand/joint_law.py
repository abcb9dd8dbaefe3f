"""The law of the joints: torques that make every joint's error that of a damped oscillator, as
stiff as is wanted.

torque = M(q) (2 d w (qd_wanted - qd) + s w^2 e) + S e + torque of tip forces + weight(q) +
friction(qd_wanted)

e = q_wanted - q. `s`, 0 to 1 a joint, is the part of the stiffness that acts; S is that of tips
which are springs. The damping always acts, so a finger that only exerts a force is still slow. The
weight of a finger is small, but at a joint that is soft it would cost degrees. Viscous friction is
fed forward for the velocity wanted, not for the one sensed: what damps is not cancelled. The sample
is taken on to when the torque acts, a valve's lag included, at the velocity sensed.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.algebra import Array, Mask
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Dynamics
from rack.levels.servo.driver import numbers
from rack.levels.tables import NotNegative, Positive, Table


class JointGains(Table):
    """Gains of the joint loop."""

    bandwidth: Positive = Field(35.0, le=400.0)
    """natural frequency of the error in every joint, rad/s"""
    damping: Positive = Field(0.7, le=5.0)
    """damping ratio that the loop adds to the friction of joints"""
    ahead: NotNegative = Field(0.006, le=0.1)
    """time from a command of tensions until they have come, s"""


class JointLaw:
    """Sets the torques of some joints of a hand."""

    def __init__(self, cell: Cell, driven: Mask, gains: JointGains) -> None:
        """Drive the joints `driven`, (joints,)."""
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(len(driven))
        viscous = cell.model.dof_damping[cell.dof]
        # In the rows of `set_joint_torques`.
        self._constants = np.array((self._dynamics.dry, viscous, cell.bounds.torque, driven))
        self._gains = gains.bandwidth**2, 2.0 * gains.damping * gains.bandwidth
        self._ahead = gains.ahead
        self._set = set_joint_torques.load()
        self.clipped = 0  # cycles in which a torque was cut to what the tendons can give

    def torques(
        self, hand: Message, target: Message, age_s: float, ahead_s: float, out: Array
    ) -> None:
        """Set `out`, (joints,), N m, for when the sample in a `HAND_STATUS` is `age_s` old; the
        `FINGER_TARGET` is taken on by `ahead_s`."""
        terms = self._dynamics.terms(hand.position, self._still)
        is_cut = self._set(
            self._gains,
            (age_s + self._ahead, ahead_s),
            self._constants,
            numbers(hand, "position", "velocity").reshape(2, -1),
            numbers(target, "position", "torque").reshape(4, -1),
            target.spring,
            terms.inertia,
            terms.bias,
            out,
        )
        if is_cut:
            self.clipped += 1


@compiled_for(
    "UniTuple(f8, 2), UniTuple(f8, 2), f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], "
    "f8[:,::1], f8[::1], f8[::1]"
)
def set_joint_torques(
    gains: tuple[float, float],  # stiffness, 1/s2, and damping, 1/s
    times: tuple[float, float],  # s: by which the sample, and the target, are taken on
    constants: Array,  # (4, joints): rows as below
    state: Array,  # (2, joints): rad, rad/s
    wanted: Array,  # (4, joints): rad, rad/s, part of the stiffness, N m
    spring: Array,  # (joints, joints), N m/rad
    inertia: Array,  # (joints, joints), kg m2
    weight: Array,  # (joints,), N m
    torque: Array,  # (joints,), N m: set; 0 for joints of other boards
) -> bool:
    """Set the torques; return whether a limit cut one."""
    dry = constants[0]  # N m
    viscous = constants[1]  # N m s/rad
    limit = constants[2]  # N m
    driven = constants[3]  # 1: a joint of this board; 0: of another
    joints = len(torque)
    clipped = False
    for j in range(joints):
        torque[j] = 0.0
        if driven[j] != 0.0:
            friction = viscous[j] * wanted[1, j] + dry[j] * math.tanh(wanted[1, j] / FRICTION_SPEED)
            torque[j] = weight[j] + wanted[3, j] + friction
    for k in range(joints):
        if driven[k] == 0.0:
            continue
        away = wanted[0, k] + times[1] * wanted[1, k] - state[0, k] - times[0] * state[1, k]
        acceleration = gains[0] * wanted[2, k] * away + gains[1] * (wanted[1, k] - state[1, k])
        for j in range(joints):
            if driven[j] != 0.0:
                torque[j] += inertia[j, k] * acceleration + spring[j, k] * away
    for j in range(joints):
        if driven[j] != 0.0:
            needed = torque[j]
            torque[j] = np.minimum(np.maximum(needed, -limit[j]), limit[j])  # NaN stays
            clipped = clipped or needed != torque[j]
    return clipped
