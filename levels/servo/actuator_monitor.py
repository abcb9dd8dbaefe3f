"""Detects from the motion of the arm when a motor does not give its commanded torque."""

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
from rack.levels.robot.limits import (
    MAX_CONTACT_FRACTION,
    MAX_RESTING_CONTACT_FRACTION,
    MIN_TURNING_JOINTS,
)

NOISE_PART = 0.005
"""Part of a torque limit that the equation of motion may leave unexplained. Runs without faults
reach a tenth of it."""
LACKING_PART = 0.02
"""Part of its torque limit by which a motor must fall short to be at fault."""
SURE_CYCLES = 4
"""Cycles needed to distinguish a motor whose torque does not rise with its command from a load on
the arm."""
RISE_PART = 0.3
"""Minimum part of a rise in commanded torque that a working motor gives."""
DEAD_PART = 0.5
"""Part of its commanded torque by which a motor must fall short to count as dead where dry
friction may hide its torque."""
URGENT_SPEED_PART = 0.99
"""Part of a velocity limit. If a joint may soon reach it while a motor lacks torque, the motor
counts as failed without further evidence."""
TURNING = 2.0
"""Speed, in multiples of `FRICTION_SPEED`, below which the dry friction of a joint is uncertain."""
MOTORS = np.dtype(
    [
        ("velocity", "f8"),  # rad/s: at the start of the cycle
        ("earlier_velocity", "f8"),  # rad/s: at the start of the cycle before
        ("bias", "f8"),  # N m: of gravity and velocities, at the start
        ("torque", "f8"),  # N m: given in the cycle
        ("dry", "f8"),  # N m: dry friction
        ("friction_s", "f8"),  # s: time constant of simulated dry friction
        ("exact_noise", "f8"),  # N m: permitted residual with exact encoders
        ("uncertain", "f8"),  # rad/s2: apparent acceleration from encoder errors
        ("off", "f8"),  # rad: largest error of a position
        ("left", "f8"),  # N m: torque left unexplained in the cycle
        ("noise", "f8"),  # N m: part of it that may be noise
        ("least_friction", "f8"),  # N m: range of dry friction in the cycle
        ("most_friction", "f8"),  # N m
    ]
)
"""State of the monitor for one motor."""
EXPLAINED = 0
UNEXPLAINED = 1
ASTRAY = 2
"""Verdicts on a cycle: all torque is explained, some is not, or a joint has left its set point."""


class ActuatorMonitor:
    """Compares the torques that the sensed motion requires with the commanded torques.

    They differ if a motor gives less than commanded, or if something pushes the arm. The first
    difference that weak motors cannot explain is attributed to a push, and so are all further ones
    until there is no difference. During a push, a motor only counts as failed if it lacks more than
    `MAX_CONTACT_FRACTION` of its torque limit. For a cycle or two, a load that pulls at the arm
    looks like a weak motor. Unlike a weak one, however, a working motor gives more torque when more
    is commanded.

    A motor also counts as failed if its joint is farther than `following`, in rad, from its set
    point. That is the only criterion for drives that do not report the torque that they give.
    """

    def __init__(
        self, cell: Cell, following: float, period_s: float, is_reported: bool = True
    ) -> None:
        """Monitor the motors of an arm.

        Args:
            cell: Model of the arm.
            following: Largest permitted distance of a joint from its set point, rad.
            period_s: Time from cycle to cycle.
            is_reported: False if `torque` is not known to be what the motors give.
        """
        model = cell.model
        dof = cell.dof
        joints = len(cell.dof)
        self._limits = cell.bounds.torque
        self._fastest = URGENT_SPEED_PART * cell.bounds.velocity
        self._motors = motors = np.zeros(joints, MOTORS)
        self.torque: Array = motors["torque"]
        """Torques commanded for the coming cycle, (joints,), N m. The level fills them in."""
        motors["dry"] = model.dof_frictionloss[dof]
        # Simulated friction slows a joint like a damper with this time constant. If the joint
        # brakes harder, the friction changes sign before the velocity does.
        motors["friction_s"] = np.maximum(model.dof_solref[dof, 0], 0.0) * model.dof_solimp[dof, 1]
        motors["exact_noise"] = NOISE_PART * self._limits
        # Encoder errors may look like a change in velocity of this size.
        motors["uncertain"] = 2.0 * cell.encoders.velocity_error / period_s
        motors["off"] = cell.encoders.position_error
        inertia = np.zeros((joints, joints))  # kg m2: at the start of the cycle
        self._judge = partial(
            compute_residuals.load_machine_code(), motors, inertia, 0.5 / period_s, following
        )
        self._reported = is_reported
        self._begun = False
        self._pushed = False  # weak motors alone do not explain the difference
        # Number of consecutive cycles in which a motor has lacked torque, and its joint.
        self._cycles = 0
        self._joint = -1
        # N m: torque commanded and given in the first of these cycles, and the most given since.
        self._commanded = self._exerted = self._most_exerted = 0.0
        self._alone = True  # it is the only motor that lacks torque

    def begin_cycle(self) -> None:
        """Begin a cycle with the commanded `torque`, at the state of the last `check_cycle`."""
        self._begun = True

    def drop_cycle(self) -> None:
        """Exclude the present cycle from the check.

        Call this if the arm was braked, cycles were missed or there was no usable sample.
        """
        self._begun = self._pushed = False
        self._cycles = 0

    def check_cycle(self, wanted: Array, state: Array, terms: Terms, holds: bool) -> Finding | None:
        """Check the cycle that ends now, and store its final state as the start of the next one.

        Args:
            wanted: Set points now; the first row is positions, (joints,), rad.
            state: Sensed positions, rad, and velocities, rad/s, (2, joints).
            terms: Equation of motion at that state.
            holds: True if the gripper holds a part, which may touch something.

        Returns:
            Finding that names a failed motor, or None.
        """
        verdict = self._judge(wanted, state, terms.inertia, terms.bias)
        if not self._begun:
            return None
        if verdict == EXPLAINED or (verdict == UNEXPLAINED and not self._reported):
            self._cycles = 0
            self._pushed = False
            return None
        if verdict == ASTRAY:
            astray = wanted[0] - state[0]
            joint = int((np.abs(astray) - self._motors["off"]).argmax())
            return Finding(Alarm.ACTUATOR, joint, float(astray[joint]))
        return self._track_lacking_torque(state[1], holds)

    def _track_lacking_torque(self, velocity: Array, holds: bool) -> Finding | None:
        """Track the motor whose lack of torque explains the difference.

        Args:
            velocity: Sensed velocities, (joints,), rad/s.
            holds: True if the gripper holds a part, which may touch something.

        Returns:
            Finding that names the motor once its failure is certain. Until then None.
        """
        motors = self._motors
        residual = motors["left"]
        noise = motors["noise"]
        commanded = np.abs(self.torque)
        lacks = residual * np.sign(self.torque)
        explained = (lacks >= -noise) & (lacks <= commanded + noise)
        if not self._pushed and not explained.all():
            self._pushed = True
            self._cycles = 0
        share = np.where(explained, lacks / self._limits, 0.0)
        # While a joint turns, its dry friction is known, so a push on it can be detected.
        is_known = motors["most_friction"] - motors["least_friction"] <= noise
        rests = np.count_nonzero(is_known) < MIN_TURNING_JOINTS
        permitted_share = LACKING_PART
        if self._pushed:
            permitted_share = MAX_CONTACT_FRACTION
        elif rests and holds:
            permitted_share = MAX_RESTING_CONTACT_FRACTION
        min_share = np.maximum(permitted_share, noise / self._limits)
        joint = (
            self._joint
            if self._cycles and share[self._joint] > min_share[self._joint]
            else int(share.argmax())
        )
        if share[joint] <= min_share[joint]:
            self._cycles = 0
            return None
        exerted = commanded[joint] - lacks[joint]
        if self._cycles == 0 or joint != self._joint:
            self._joint = joint
            self._cycles = 0
            self._commanded = commanded[joint]
            self._exerted = exerted
            self._most_exerted = 0.0
            self._alone = True
        self._cycles += 1
        self._most_exerted = max(self._most_exerted, abs(exerted))
        self._alone &= not rests and np.count_nonzero(np.abs(residual) > noise) == 1
        predicted_speed = np.abs(velocity) + 2.0 * np.abs(velocity - motors["earlier_velocity"])
        if (predicted_speed > self._fastest).any() or self._is_certain(
            joint, commanded[joint], lacks[joint]
        ):
            self._cycles = 0
            return Finding(Alarm.ACTUATOR, joint, float(lacks[joint]))
        return None

    def _is_certain(self, joint: int, commanded: float, lacks: float) -> bool:
        """Return True if the failure of the motor is certain.

        In several cycles the motor must have given no torque, have given no more when more was
        commanded, or have lacked more than a push can explain. Dry friction that changes sign can
        hide a dead motor, because it looks like a torque of up to twice the friction.

        Args:
            joint: Joint of the motor.
            commanded: Size of the commanded torque, N m.
            lacks: Part of the commanded torque that was not given, N m.
        """
        if self._cycles < SURE_CYCLES:
            return False
        if self._pushed:
            return True
        more = commanded - self._commanded
        rise = commanded - lacks - self._exerted
        motor = self._motors[joint]
        certain = 2.0 * motor["noise"]
        hidden = 2.0 * motor["dry"] if self._alone and lacks >= DEAD_PART * commanded else 0.0
        return bool(
            self._most_exerted <= certain + hidden or (more > certain and rise < RISE_PART * more)
        )


@compiled_for("f8[:,::1], f8, f8, f8[:,::1], f8[:,::1], f8[:,::1], f8[::1]", MOTORS)
def compute_residuals(
    motors: NDArray[np.void],  # (joints,): MOTORS
    inertia_before: Array,  # (joints, joints), kg m2
    half_rate: float,  # 1/s
    following: float,  # rad
    wanted: Array,  # (3, joints), rad: positions in the first row
    state: Array,  # (2, joints), rad, rad/s
    inertia: Array,  # (joints, joints), kg m2
    bias: Array,  # (joints,), N m
) -> int:
    """Compare the torques that a motion required with the commanded ones; store the final state.

    Args:
        motors: State of the monitor.
        inertia_before: Inertia at the start of the cycle; replaced by `inertia`.
        half_rate: Half the number of cycles per second.
        following: Largest permitted distance from a set point.
        wanted: Set points now.
        state: Sensed state now.
        inertia: Inertia now.
        bias: Torques of gravity and velocities now.

    Returns:
        EXPLAINED, UNEXPLAINED or ASTRAY.
    """
    position, velocity = state
    verdict = EXPLAINED
    for j in range(len(motors)):
        motor = motors[j]
        residual = motor["torque"] - 0.5 * (motor["bias"] + bias[j])
        noise = motor["exact_noise"]
        for k in range(len(motors)):
            residual -= (inertia_before[j, k] + inertia[j, k]) * (
                half_rate * (velocity[k] - motors[k]["velocity"])
            )
            noise += abs(inertia[j, k]) * motors[k]["uncertain"]
        before = motor["velocity"]
        later_velocity = velocity[j] + motor["friction_s"] * (half_rate * (velocity[j] - before))
        slowest = min(later_velocity, before)
        fastest = max(later_velocity, before)
        min_friction = motor["dry"] * math.tanh(slowest / FRICTION_SPEED - TURNING)
        max_friction = motor["dry"] * math.tanh(fastest / FRICTION_SPEED + TURNING)
        residual -= min(max(residual, min_friction), max_friction)
        motor["left"] = residual
        motor["noise"] = noise
        motor["least_friction"] = min_friction
        motor["most_friction"] = max_friction
        if abs(residual) > noise:
            verdict = max(verdict, UNEXPLAINED)
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
