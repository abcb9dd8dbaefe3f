"""Judges from the arm's motion whether its motors give the commanded torques."""

from __future__ import annotations

import math

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, each, mat_vec
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Terms
from rack.levels.robot.limits import MAX_CONTACT_PART, MAX_RESTING_CONTACT_PART, MIN_TURNING_JOINTS

NOISE_PART = 0.005
"""Part of a torque limit that the equation of motion may leave unexplained: ten times that of faultless runs."""
LACKING_PART = 0.02
"""Part of its torque limit that a motor must lack to be at fault."""
SURE_CYCLES = 4
"""Cycles needed to distinguish a motor whose torque does not rise with its command from a load on the arm."""
RISE_PART = 0.3
"""Least part of a rise in torque that a sound motor gives."""
DEAD_PART = 0.5
"""Part of its torque that a motor must lack to count as dead where dry friction hides its torque."""
URGENT_SPEED_PART = 0.99
"""Part of a velocity limit: if a joint may reach it while motors lack torque, there is no time to be certain."""
TURNING = np.array([[-2.0], [2.0]])
"""Velocities, in `FRICTION_SPEED`, between which dry friction may be anything up to its full value."""


class ActuatorMonitor:
    """Compares the torques that a motion took with the torques commanded for it.

    A difference comes from motors that gave less than commanded, or from an external push: in that case, until the
    difference is gone, only a motor that lacks more than `MAX_CONTACT_PART` has failed. For a cycle or two, a pulling
    load looks like a motor that lacks torque; but under load, a motor commanded more gives more. A motor has also
    failed when the arm strays from its set points by more than `following`, rad.
    """

    def __init__(self, cell: Cell, following: float, period_s: float) -> None:
        self._limits, self._dry = cell.bounds.torque, np.array(cell.model.dof_frictionloss[cell.dof])
        self._following, self._period_s = following, period_s
        # Simulated friction slows a joint as a damper of that time constant does: if the joint brakes harder, the
        # friction changes sign before the velocity does.
        model, dof = cell.model, cell.dof
        self._early = np.maximum(model.dof_solref[dof, 0], 0.0) * model.dof_solimp[dof, 1]
        self._fastest = URGENT_SPEED_PART * cell.bounds.velocity
        self._least, self._speed_off = NOISE_PART * self._limits, cell.encoders.speed_off
        self._exact, self._off = cell.encoders.exact, cell.encoders.off
        self._noise = self._least
        joints = len(self._dry)
        self._inertia, self._twice_inertia = np.zeros((joints, joints)), np.zeros((joints, joints))
        self._bias, self._velocity, self._torque = np.zeros((3, joints))
        self._friction = np.zeros((2, joints))
        self._begun = False
        self._pushed = False  # weak motors do not explain the difference
        self._cycles, self._joint = 0, -1  # cycles for which a motor has lacked torque, and its joint
        self._commanded = self._given = self._most = 0.0  # N m: commanded and given at first, most given since
        self._alone = True  # it is the only motor that lacks torque

    def begin(self, velocity: Array, terms: Terms, torque: Array) -> None:
        """Record velocity, rad/s, terms and commanded torques, N m, at the beginning of a cycle."""
        np.copyto(self._velocity, velocity)
        np.copyto(self._inertia, terms.inertia)
        np.copyto(self._bias, terms.bias)
        np.copyto(self._torque, torque)
        self._begun = True

    def drop(self) -> None:
        """Forget the cycle that was begun: brakes, missed cycles or wrong samples intervened."""
        self._begun = self._pushed = False
        self._cycles = 0

    def look(self, velocity: Array, terms: Terms, astray: Array, holds: bool) -> Finding | None:
        """Judge the cycle that ends now, at `velocity`, rad/s; `astray` is the distance from the set points, rad.

        `holds`: the gripper holds a part, which may touch something.
        """
        if not self._begun:
            return None
        far = np.abs(astray) - self._off
        if np.count_nonzero(far > self._following):
            joint = int(far.argmax())
            return Finding(Alarm.ACTUATOR, joint, float(astray[joint]))
        left = self._left_over(velocity, terms)
        if not self._exact:
            # The change in velocity that the encoders' errors may simulate.
            self._noise = self._least + mat_vec(np.abs(terms.inertia), 2.0 * self._speed_off / self._period_s)
        if not np.count_nonzero(np.abs(left) > self._noise):
            self._cycles, self._pushed = 0, False
            return None
        return self._lacking(left, velocity, holds)

    def _left_over(self, velocity: Array, terms: Terms) -> Array:
        """Return the torques, N m, taken neither by the motion nor by dry friction."""
        gain = velocity - self._velocity
        gain *= 0.5 / self._period_s
        np.add(self._inertia, terms.inertia, out=self._twice_inertia)
        left = self._bias + terms.bias
        left *= -0.5
        left += self._torque
        left -= mat_vec(self._twice_inertia, gain)
        gain *= self._early
        gain += velocity
        friction = self._friction
        np.minimum(gain, self._velocity, out=friction[0])
        np.maximum(gain, self._velocity, out=friction[1])
        friction /= FRICTION_SPEED
        friction += TURNING
        friction[:] = each(math.tanh, friction)
        friction *= self._dry
        return np.asarray(left - np.minimum(np.maximum(left, friction[0]), friction[1]))

    def _lacking(self, left: Array, velocity: Array, holds: bool) -> Finding | None:
        """Follow cycles in which motors that lack torque explain the difference, until it is certain."""
        commanded = np.abs(self._torque)
        lacks = left * np.sign(self._torque)
        explained = (lacks >= -self._noise) & (lacks <= commanded + self._noise)
        if not self._pushed and not explained.all():
            self._pushed, self._cycles = True, 0
        share = np.where(explained, lacks / self._limits, 0.0)
        # While a joint turns, its dry friction is known, and any push shows.
        rests = np.count_nonzero(self._friction[1] - self._friction[0] <= self._noise) < MIN_TURNING_JOINTS
        part = MAX_CONTACT_PART if self._pushed else MAX_RESTING_CONTACT_PART if rests and holds else LACKING_PART
        least = np.maximum(part, self._noise / self._limits)
        joint = self._joint if self._cycles and share[self._joint] > least[self._joint] else int(share.argmax())
        if share[joint] <= least[joint]:
            self._cycles = 0
            return None
        if self._cycles == 0 or joint != self._joint:
            self._joint, self._cycles = joint, 0
            self._commanded, self._given = commanded[joint], commanded[joint] - lacks[joint]
            self._most, self._alone = 0.0, True
        self._cycles += 1
        self._most = max(self._most, abs(commanded[joint] - lacks[joint]))
        self._alone &= not rests and np.count_nonzero(np.abs(left) > self._noise) == 1
        ahead = np.abs(velocity) + 2.0 * np.abs(velocity - self._velocity)
        if (ahead > self._fastest).any() or self._sure(joint, commanded[joint], lacks[joint]):
            self._cycles = 0
            return Finding(Alarm.ACTUATOR, joint, float(lacks[joint]))
        return None

    def _sure(self, joint: int, commanded: float, lacks: float) -> bool:
        """Return whether it is certain that the motor has failed.

        It gives nothing, or no more when commanded more, or it lacks more than a push may take. Dry friction that
        changes sign may look like torque of a dead motor, up to twice its value.
        """
        if self._cycles < SURE_CYCLES:
            return False
        if self._pushed:
            return True
        more, rise = commanded - self._commanded, commanded - lacks - self._given
        certain = 2.0 * self._noise[joint]
        hidden = 2.0 * self._dry[joint] if self._alone and lacks >= DEAD_PART * commanded else 0.0
        return bool(self._most <= certain + hidden or (more > certain and rise < RISE_PART * more))
