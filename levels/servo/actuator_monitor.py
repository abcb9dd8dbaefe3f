"""Judges from the arm's motion whether its motors give the commanded torques."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

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
MOTORS = np.dtype(
    [
        ("velocity", "f8"),  # rad/s: at the beginning of the cycle
        ("earlier_velocity", "f8"),  # rad/s: at that of the cycle before
        ("bias", "f8"),  # N m: of gravity and velocities, at the beginning
        ("torque", "f8"),  # N m: given in the cycle
        ("dry", "f8"),  # N m: dry friction
        ("friction_s", "f8"),  # s: time constant of the simulated one
        ("exact_noise", "f8"),  # N m: left unexplained with exact encoders
        ("uncertain", "f8"),  # rad/s2: acceleration that other encoders may simulate
        ("off", "f8"),  # rad: error of a position
        ("left", "f8"),  # N m: left unexplained in the cycle
        ("noise", "f8"),  # N m: what of it may be noise
        ("least_friction", "f8"),  # N m
        ("most_friction", "f8"),  # N m
    ]
)
"""What is known of a joint's motor."""
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
        self._motors = motors = np.zeros(joints, MOTORS)
        self.torque: Array = motors["torque"]
        """Torques given in the cycle that begins, (joints,), N m; the level fills them in."""
        motors["dry"] = model.dof_frictionloss[dof]
        # Simulated friction slows a joint as a damper of that time constant does: if the joint
        # brakes harder, the friction changes sign before the velocity does.
        motors["friction_s"] = np.maximum(model.dof_solref[dof, 0], 0.0) * model.dof_solimp[dof, 1]
        motors["exact_noise"] = NOISE_PART * self._limits
        # The change in velocity that the encoders' errors may simulate.
        motors["uncertain"] = 2.0 * cell.encoders.speed_off / period_s
        motors["off"] = cell.encoders.off
        inertia = np.zeros((joints, joints))  # kg m2: at the beginning of the cycle
        self._judge = partial(left_over.load(), motors, inertia, 0.5 / period_s, following)
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
            joint = int((np.abs(astray) - self._motors["off"]).argmax())
            return Finding(Alarm.ACTUATOR, joint, float(astray[joint]))
        return self._lacking(state[1], holds)

    def _lacking(self, velocity: Array, holds: bool) -> Finding | None:
        """Follow cycles in which motors that lack torque explain the difference, until it is
        certain.
        """
        motors = self._motors
        left = motors["left"]
        noise = motors["noise"]
        commanded = np.abs(self.torque)
        lacks = left * np.sign(self.torque)
        explained = (lacks >= -noise) & (lacks <= commanded + noise)
        if not self._pushed and not explained.all():
            self._pushed = True
            self._cycles = 0
        share = np.where(explained, lacks / self._limits, 0.0)
        # While a joint turns, its dry friction is known, and any push shows.
        is_known = motors["most_friction"] - motors["least_friction"] <= noise
        rests = np.count_nonzero(is_known) < MIN_TURNING_JOINTS
        part = LACKING_PART
        if self._pushed:
            part = MAX_CONTACT_PART
        elif rests and holds:
            part = MAX_RESTING_CONTACT_PART
        least = np.maximum(part, noise / self._limits)
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
        self._alone &= not rests and np.count_nonzero(np.abs(left) > noise) == 1
        ahead = np.abs(velocity) + 2.0 * np.abs(velocity - motors["earlier_velocity"])
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
        motor = self._motors[joint]
        certain = 2.0 * motor["noise"]
        hidden = 2.0 * motor["dry"] if self._alone and lacks >= DEAD_PART * commanded else 0.0
        return bool(self._most <= certain + hidden or (more > certain and rise < RISE_PART * more))


@compiled_for("f8[:,::1], f8, f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[::1]", MOTORS)
def left_over(
    motors: NDArray[np.void],  # (joints,): MOTORS
    inertia_before: Array,  # (joints, joints), kg m2: at the beginning of the cycle
    half_rate: float,  # 1/s: of the cycles
    following: float,  # rad
    wanted: Array,  # (3, joints), rad: positions in the first row
    state: Array,  # (2, joints), rad, rad/s: now
    inertia: Array,  # (joints, joints), kg m2: now
    bias: Array,  # (joints,), N m: now
) -> int:
    """Compare the torques that a motion took with those commanded; keep the present state for the
    next cycle.
    """
    position, velocity = state
    verdict = EXPLAINED
    for j in range(len(motors)):
        motor = motors[j]
        left = motor["torque"] - 0.5 * (motor["bias"] + bias[j])
        noise = motor["exact_noise"]
        for k in range(len(motors)):
            left -= (inertia_before[j, k] + inertia[j, k]) * (
                half_rate * (velocity[k] - motors[k]["velocity"])
            )
            noise += abs(inertia[j, k]) * motors[k]["uncertain"]
        before = motor["velocity"]
        ahead = velocity[j] + motor["friction_s"] * (half_rate * (velocity[j] - before))
        slowest = min(ahead, before)
        fastest = max(ahead, before)
        least = motor["dry"] * math.tanh(slowest / FRICTION_SPEED - TURNING)
        most = motor["dry"] * math.tanh(fastest / FRICTION_SPEED + TURNING)
        left -= min(max(left, least), most)
        motor["left"] = left
        motor["noise"] = noise
        motor["least_friction"] = least
        motor["most_friction"] = most
        if abs(left) > noise:
            verdict = max(verdict, LEFT_OVER)
        if abs(wanted[0, j] - position[j]) - motor["off"] > following:
            verdict = ASTRAY
    for j in range(len(motors)):
        motor = motors[j]
        motor["earlier_velocity"] = motor["velocity"]
        motor["velocity"] = velocity[j]
        motor["bias"] = bias[j]
        for k in range(len(motors)):
            inertia_before[j, k] = inertia[j, k]
    return verdict
