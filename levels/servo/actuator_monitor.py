"""Judges from the arm's motion whether its motors give the commanded torques."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Terms
from rack.levels.robot.limits import MAX_CONTACT_PART, MAX_RESTING_CONTACT_PART, MIN_TURNING_JOINTS

NOISE_PART = 0.005
"""Part of a torque limit that the equation of motion may leave unexplained: ten times that of
faultless runs."""
LACKING_PART = 0.02
"""Part of its torque limit that a motor must lack to be at fault."""
SURE_CYCLES = 4
"""Cycles needed to distinguish a motor whose torque does not rise with its command from a load on
the arm."""
RISE_PART = 0.3
"""Least part of a rise in torque that a sound motor gives."""
DEAD_PART = 0.5
"""Part of its torque that a motor must lack to count as dead where dry friction hides its
torque."""
URGENT_SPEED_PART = 0.99
"""Part of a velocity limit: if a joint may reach it while motors lack torque, there is no time to
be certain."""
TURNING = 2.0
"""Speed, in `FRICTION_SPEED`, up to which dry friction may be anything up to its full value."""


EXPLAINED = 0
LEFT_OVER = 1
ASTRAY = 2
"""Verdicts on a cycle: nothing, or some torque, is left unexplained; a joint has strayed from its
set points."""


class ActuatorMonitor:
    """Compares the torques that a motion took with the torques commanded for it.

    A difference comes from motors that gave less than commanded, or from an external push: in that
    case, until the difference is gone, only a motor that lacks more than `MAX_CONTACT_PART` has
    failed. For a cycle or two, a pulling load looks like a motor that lacks torque; but under load,
    a motor commanded more gives more. A motor has also failed when the arm strays from its set
    points by more than `following`, rad. That alone counts where drives do not report what torque
    they give.
    """

    def __init__(
        self, cell: Cell, following: float, period_s: float, is_reported: bool = True
    ) -> None:
        model = cell.model
        dof = cell.dof
        joints = len(cell.dof)
        self._limits = cell.bounds.torque
        self._fastest = URGENT_SPEED_PART * cell.bounds.velocity
        self._table = np.zeros((13 + joints, joints))  # in the rows of `left_over`
        # `torque`, (joints,), N m: given in the cycle that begins; the level fills it in.
        self.torque, self._dry, early, least, uncertain, self._off = self._table[2:8]
        self._left, self._noise, *self._friction, self._velocity = self._table[8:13]
        self._dry[:] = model.dof_frictionloss[dof]
        # Simulated friction slows a joint as a damper of that time constant does: if the joint
        # brakes harder, the friction changes sign before the velocity does.
        early[:] = np.maximum(model.dof_solref[dof, 0], 0.0) * model.dof_solimp[dof, 1]
        least[:] = NOISE_PART * self._limits
        # The change in velocity that the encoders' errors may simulate.
        uncertain[:] = 2.0 * cell.encoders.speed_off / period_s
        self._off[:] = cell.encoders.off
        self._judge = partial(left_over.load(), self._table, 0.5 / period_s, following)
        self._reported = is_reported
        self._begun = False
        self._pushed = False  # weak motors do not explain the difference
        # For how many cycles a motor has lacked torque, and its joint.
        self._cycles = 0
        self._joint = -1
        self._commanded = self._given = self._most = (
            0.0  # N m: commanded and given at first, most given since
        )
        self._alone = True  # it is the only motor that lacks torque

    def begin(self) -> None:
        """Begin a cycle with `torque`, at the velocity and terms last looked at."""
        self._begun = True

    def drop(self) -> None:
        """Forget the cycle that was begun: brakes, missed cycles or wrong samples intervened."""
        self._begun = self._pushed = False
        self._cycles = 0

    def look(self, wanted: Array, state: Array, terms: Terms, holds: bool) -> Finding | None:
        """Judge the cycle that ends now, at a state, rad and rad/s, where the set points are at
        `wanted`, rad.

        `wanted` and `state` begin with a row of positions, (joints,); then follow velocities.
        `holds`: the gripper holds a part, which may touch something. Velocity and terms are kept
        for the cycle that may begin.
        """
        verdict = self._judge(wanted, state, terms.inertia, terms.bias)
        if not self._begun:
            return None
        if verdict == EXPLAINED or (verdict == LEFT_OVER and not self._reported):
            self._cycles = 0
            self._pushed = False
            return None
        if verdict == ASTRAY:
            astray = wanted[0] - state[0]
            joint = int((np.abs(astray) - self._off).argmax())
            return Finding(Alarm.ACTUATOR, joint, float(astray[joint]))
        return self._lacking(self._left, state[1], holds)

    def _lacking(self, left: Array, velocity: Array, holds: bool) -> Finding | None:
        """Follow cycles in which motors that lack torque explain the difference, until it is
        certain."""
        commanded = np.abs(self.torque)
        lacks = left * np.sign(self.torque)
        explained = (lacks >= -self._noise) & (lacks <= commanded + self._noise)
        if not self._pushed and not explained.all():
            self._pushed = True
            self._cycles = 0
        share = np.where(explained, lacks / self._limits, 0.0)
        # While a joint turns, its dry friction is known, and any push shows.
        rests = (
            np.count_nonzero(self._friction[1] - self._friction[0] <= self._noise)
            < MIN_TURNING_JOINTS
        )
        part = LACKING_PART
        if self._pushed:
            part = MAX_CONTACT_PART
        elif rests and holds:
            part = MAX_RESTING_CONTACT_PART
        least = np.maximum(part, self._noise / self._limits)
        joint = (
            self._joint
            if self._cycles and share[self._joint] > least[self._joint]
            else int(share.argmax())
        )
        if share[joint] <= least[joint]:
            self._cycles = 0
            return None
        if self._cycles == 0 or joint != self._joint:
            self._joint = joint
            self._cycles = 0
            self._commanded = commanded[joint]
            self._given = commanded[joint] - lacks[joint]
            self._most = 0.0
            self._alone = True
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

        It gives nothing, or no more when commanded more, or it lacks more than a push may take. Dry
        friction that changes sign may look like torque of a dead motor, up to twice its value.
        """
        if self._cycles < SURE_CYCLES:
            return False
        if self._pushed:
            return True
        more = commanded - self._commanded
        rise = commanded - lacks - self._given
        certain = 2.0 * self._noise[joint]
        hidden = 2.0 * self._dry[joint] if self._alone and lacks >= DEAD_PART * commanded else 0.0
        return bool(self._most <= certain + hidden or (more > certain and rise < RISE_PART * more))


@compiled_for("f8[:,::1], f8, f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[::1]")
def left_over(
    table: Array,  # (13 + joints, joints): rows as below
    half_rate: float,  # 1/s: of the cycles
    following: float,  # rad
    wanted: Array,  # (3, joints), rad: positions in the first row
    state: Array,  # (2, joints), rad, rad/s: now
    inertia: Array,  # (joints, joints), kg m2: now
    bias: Array,  # (joints,), N m: now
) -> int:
    """Compare the torques that a motion took with those commanded; keep the present state for the
    next cycle."""
    # At the beginning of the cycle: rad/s, N m, N m. Dry friction, N m, and time constant of the
    # simulated one, s. Noise of exact encoders, N m; acceleration that others may simulate, rad/s2;
    # error of the positions, rad.
    velocity_before, bias_before, torque, dry, early, noise, uncertain, off = table[:8]
    inertia_before = table[13:]  # kg m2
    position = state[0]
    velocity = state[1]
    verdict = EXPLAINED
    for j in range(len(velocity)):
        left = torque[j] - 0.5 * (bias_before[j] + bias[j])
        unsure = noise[j]
        for k in range(len(velocity)):
            left -= (inertia_before[j, k] + inertia[j, k]) * (
                half_rate * (velocity[k] - velocity_before[k])
            )
            unsure += abs(inertia[j, k]) * uncertain[k]
        ahead = velocity[j] + early[j] * (half_rate * (velocity[j] - velocity_before[j]))
        slowest = min(ahead, velocity_before[j])
        fastest = max(ahead, velocity_before[j])
        least = dry[j] * math.tanh(slowest / FRICTION_SPEED - TURNING)
        most = dry[j] * math.tanh(fastest / FRICTION_SPEED + TURNING)
        left -= min(max(left, least), most)
        # Set, N m: what is left over, what of it may be noise, least and most friction.
        table[8, j] = left
        table[9, j] = unsure
        table[10, j] = least
        table[11, j] = most
        if abs(left) > unsure:
            verdict = max(verdict, LEFT_OVER)
        if abs(wanted[0, j] - position[j]) - off[j] > following:
            verdict = ASTRAY
    for j in range(len(velocity)):
        table[12, j] = velocity_before[j]
        velocity_before[j] = velocity[j]
        bias_before[j] = bias[j]
        for k in range(len(velocity)):
            inertia_before[j, k] = inertia[j, k]
    return verdict
