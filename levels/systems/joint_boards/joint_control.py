"""The law of a board that servoes joints of an arm, each by itself with given inertia and load."""

from __future__ import annotations

import math

import numpy as np

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Dynamics, Payload
from rack.levels.systems.joint_boards.messages import JointReference

MOVED_RAD = 0.01
"""Motion of a joint after which loads are computed again. Also the distance beyond its range from
which a commanded position is a mistake and not rounding."""
AT = slice(0, 2)
DUE = slice(2, 4)
"""Rows of inertia, kg m2, and load, N m, at the start of an interval and at its end."""


class JointLoads:
    """Inertia and load of every joint.

    They are interpolated between references, and computed while no reference is followed.

    Attributes:
        table: Rows `AT` and `DUE`, (4, joints).
    """

    def __init__(self, cell: Cell) -> None:
        joints = len(cell.dof)
        self.table = np.zeros((4, joints))
        self._begin = self._due = 0  # tick
        self._payload = Payload(0.0, np.zeros(3))
        self._home = cell.home
        self._torque_limits = cell.bounds.torque
        # Inertia that these torques just accelerate at the acceleration limits.
        self._most_inertia = self._torque_limits / cell.limits.acceleration
        low, high = cell.bounds.position.T
        self._low = low - MOVED_RAD
        self._high = high + MOVED_RAD
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(joints)
        # (joints,), rad. NaN if the loads come from a reference.
        self._computed_at = np.full(joints, np.nan)

    def find_invalid_field(self, command: JointReference) -> str:
        """Return the name of the first field beyond the arm's limits, or an empty string."""
        # The comparison is written so that NaN is rejected.
        within = {
            "position": (self._low <= command.position) & (command.position <= self._high),
            "inertia": (command.inertia > 0.0) & (command.inertia <= self._most_inertia),
            "load": np.abs(command.load) <= self._torque_limits,
            "payload_mass": self._can_hold(command),
        }
        return next((name for name, fits in within.items() if not np.all(fits)), "")

    def _can_hold(self, command: JointReference) -> bool:
        """Return True if the motors can hold the arm at home with the payload of a reference."""
        mass = command.payload_mass
        offset = command.payload_offset
        if mass == self._payload.mass and (offset == self._payload.offset).all():
            return True
        bias = self._dynamics.terms(self._home, self._still, Payload(mass, offset)).bias
        return bool(mass >= 0.0 and (np.abs(bias) <= self._torque_limits).all())

    def take_reference(self, command: JointReference, tick: int) -> None:
        """Interpolate from the present loads to the loads of a reference, which apply when due."""
        self.table[AT] += self.compute_passed_part(tick) * (self.table[DUE] - self.table[AT])
        self.table[DUE] = command.inertia, command.load
        self._begin = tick
        self._due = command.due
        self._payload = Payload(command.payload_mass, command.payload_offset.copy())
        self._computed_at[:] = np.nan

    def compute_passed_part(self, tick: int) -> float:
        """Return the fraction of the interval between references that has passed, 0 to 1."""
        return 1.0 if tick >= self._due else (tick - self._begin) / (self._due - self._begin)

    def compute_at_rest(self, position: Array) -> None:
        """Compute the loads of an arm at rest, if it has moved since they were computed last.

        Args:
            position: Position of the arm, (joints,), rad.
        """
        if (np.abs(position - self._computed_at) < MOVED_RAD).all():
            return
        inertia, bias = self._dynamics.terms(position, self._still, self._payload)
        self.table[AT] = self.table[DUE] = np.diagonal(inertia), bias
        self._computed_at[:] = position


@compiled_for("f8[:,::1], f8[:,::1], f8, f8, f8, f8[::1], f8[:,::1], f8[::1], f8[::1]")
def servo_joints(
    constants: Array,  # (5, joints)
    loads: Array,  # (4, joints), kg m2, N m, kg m2, N m
    part: float,  # 0 to 1
    cycle_s: float,
    age_s: float,
    arm: Array,  # (2 joints,), rad, rad/s
    wanted: Array,  # (3, joints), rad, rad/s, rad/s2
    torque: Array,  # (3 joints,), N m, rad, rad/s
    status: Array,  # (4 joints,), rad, rad, rad/s, N m
) -> None:
    """Set torques that make every joint's error decay like a damped oscillator.

    torque = inertia (qdd + 2 d w (qd_wanted - qd) + w^2 (q_wanted - q)) + load + dry friction

    The sample is extrapolated to the time at which the torques act.

    Args:
        constants: Stiffness, damping, dry friction, torque limits, and 1 for each joint of this
            board.
        loads: Inertia and load at the start of an interval and at its end.
        part: Fraction of the interval that has passed.
        cycle_s: Time until the torques act.
        age_s: Age of the sample at that time.
        arm: Sampled positions and velocities.
        wanted: Positions, velocities and accelerations to follow.
        torque: Output: torques, targets and their velocities.
        status: Output: positions, targets, their velocities, and torques.
    """
    stiffness = constants[0]  # 1/s2
    damping = constants[1]  # 1/s
    dry = constants[2]  # N m
    limits = constants[3]  # N m
    driven = constants[4]  # 0 for joints of other boards
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
        needed = np.minimum(np.maximum(needed, -limits[j]), limits[j])  # keeps NaN
        torque[j] = needed
        torque[joints + j] = target
        torque[2 * joints + j] = target_velocity
        status[joints + j] = target
        status[2 * joints + j] = target_velocity
        status[3 * joints + j] = needed
