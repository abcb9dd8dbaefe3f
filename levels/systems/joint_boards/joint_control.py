"""The law of a board that servoes joints of an arm: each by itself, with the inertia and load that
it is given.
"""

from __future__ import annotations

import math

import numpy as np

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Dynamics, Payload
from rack.levels.systems.joint_boards.messages import JointReference

MOVED_RAD = 0.01
"""Distance of a joint from where the loads were computed at which they are computed again; and
beyond its range at which a position is a mistake, not rounding."""
AT = slice(0, 2)
DUE = slice(2, 4)
"""Rows of inertia, kg m2, and load, N m: at the beginning of an interval, and at its end."""


class JointLoads:
    """Inertia and load of every joint: interpolated between references; computed where there is
    none.
    """

    def __init__(self, cell: Cell) -> None:
        joints = len(cell.dof)
        self.table = np.zeros((4, joints))  # in the rows `AT` and `DUE`
        self._begin = self._due = 0  # tick
        self._payload = Payload(0.0, np.zeros(3))
        self._home = cell.home
        self._most = cell.bounds.torque
        # What these torques accelerate as far as the arm may.
        self._most_inertia = self._most / cell.limits.acceleration
        low, high = cell.bounds.position.T
        self._low = low - MOVED_RAD
        self._high = high + MOVED_RAD
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(joints)
        # (joints,), rad; NaN: they are those of a reference.
        self._computed_at = np.full(joints, np.nan)

    def misfit(self, command: JointReference) -> str:
        """Return the field of a `JointReference` that asks for more than the arm can do; empty:
        none does.
        """
        # Written so that NaN is too much.
        within = {
            "position": (self._low <= command.position) & (command.position <= self._high),
            "inertia": (command.inertia > 0.0) & (command.inertia <= self._most_inertia),
            "load": np.abs(command.load) <= self._most,
            "payload_mass": self._can_hold(command),
        }
        return next((name for name, fits in within.items() if not np.all(fits)), "")

    def _can_hold(self, command: JointReference) -> bool:
        """Return whether the motors hold the arm at home with the payload of a reference."""
        mass = command.payload_mass
        offset = command.payload_offset
        if mass == self._payload.mass and (offset == self._payload.offset).all():
            return True
        bias = self._dynamics.terms(self._home, self._still, Payload(mass, offset)).bias
        return bool(mass >= 0.0 and (np.abs(bias) <= self._most).all())

    def take(self, command: JointReference, tick: int) -> None:
        """Go over to those of a `JointReference` that fits, until it is due."""
        self.table[AT] += self.part(tick) * (self.table[DUE] - self.table[AT])
        self.table[DUE] = command.inertia, command.load
        self._begin = tick
        self._due = command.due
        self._payload = Payload(command.payload_mass, command.payload_offset.copy())
        self._computed_at[:] = np.nan

    def part(self, tick: int) -> float:
        """Return the part of the present interval that has passed, 0 to 1."""
        return 1.0 if tick >= self._due else (tick - self._begin) / (self._due - self._begin)

    def hold(self, position: Array) -> None:
        """Compute them for an arm at rest at `position`, (joints,), rad, unless they were computed
        near it.
        """
        if (np.abs(position - self._computed_at) < MOVED_RAD).all():
            return
        inertia, bias = self._dynamics.terms(position, self._still, self._payload)
        self.table[AT] = self.table[DUE] = np.diagonal(inertia), bias
        self._computed_at[:] = position


@compiled_for("f8[:,::1], f8[:,::1], f8, f8, f8, f8[::1], f8[:,::1], f8[::1], f8[::1]")
def servo_joints(
    constants: Array,  # (5, joints): rows as below
    loads: Array,  # (4, joints): inertia, load, at the beginning of an interval and at its end
    part: float,  # of the interval that has passed
    cycle_s: float,  # until the torque acts
    age_s: float,  # of the sample, then
    arm: Array,  # (2 joints,): sampled positions, rad, and velocities, rad/s
    wanted: Array,  # (3, joints): rad, rad/s, rad/s2, now
    torque: Array,  # (3 joints,): set: torques, N m, targets, rad, and their velocities, rad/s
    status: Array,  # (4 joints,): set: positions, targets, their velocities, torques
) -> None:
    """Set torques that make every joint's error that of a damped oscillator, from a sample taken on
    to when they act.

    torque = inertia (qdd + 2 d w (qd_wanted - qd) + w^2 (q_wanted - q)) + load + dry friction
    """
    stiffness = constants[0]  # 1/s2
    damping = constants[1]  # 1/s
    dry = constants[2]  # N m
    limits = constants[3]  # N m
    driven = constants[4]  # 1: a joint of this board; 0: of another
    joints = len(driven)
    for j in range(joints):
        status[j] = arm[j]
        if driven[j] == 0.0:
            continue
        acceleration = wanted[2, j]
        position = arm[j] + age_s * (arm[joints + j] + 0.5 * age_s * acceleration)
        velocity = arm[joints + j] + age_s * acceleration
        target = wanted[0, j] + cycle_s * (wanted[1, j] + 0.5 * cycle_s * acceleration)
        target_velocity = wanted[1, j] + cycle_s * acceleration
        inertia = loads[0, j] + part * (loads[2, j] - loads[0, j])
        load = loads[1, j] + part * (loads[3, j] - loads[1, j])
        damped = acceleration + damping[j] * (target_velocity - velocity)
        needed = inertia * (damped + stiffness[j] * (target - position)) + load
        needed += dry[j] * math.tanh(target_velocity / FRICTION_SPEED)
        needed = np.minimum(np.maximum(needed, -limits[j]), limits[j])  # NaN stays
        torque[j] = needed
        torque[joints + j] = target
        torque[2 * joints + j] = target_velocity
        status[joints + j] = target
        status[2 * joints + j] = target_velocity
        status[3 * joints + j] = needed
