"""Limit gates for torques, and for set points of drives that follow position or velocity."""

from __future__ import annotations

import math
from functools import partial

import daqp
import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, mat_vec, solve
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.link import JointTarget
from rack.levels.compiled import compiled, compiled_for
from rack.levels.level import Finding
from rack.levels.robot.dynamics import FRICTION_SPEED, INERTIA_ROW, Dynamics
from rack.levels.robot.limits import Bounds, Limits

SPEED_FRACTION = 0.99
"""Fraction of a velocity limit that the gate lets a joint reach.

The rest covers model errors within a cycle.
"""
RANGE_MARGIN_RAD = 0.002
"""Distance that the gate keeps from the ends of a joint's range, in rad.

It covers model errors within a cycle.
"""
CLEAR_SPEED_FRACTION = 0.01
"""Margin to a velocity limit with which one rough prediction suffices, as a fraction of it."""
HARD = 0
SOFT = 8
"""Values of the solver's constraint types."""


class LimitGate:
    """Cuts torques so that the joints end the next cycle within limits and can still be stopped.

    A joint must be slow enough to stop, with deceleration `braking`, before the end of its range.
    The arm's equation of motion predicts the velocities. Torques that would violate a limit are
    replaced by the torques with the nearest permitted acceleration. A small quadratic program finds
    them, with precedence for torque limits. In most cycles the arm is far from all limits, and one
    rough prediction shows that nothing has to be cut.
    """

    def __init__(self, bounds: Bounds, braking: Array, period_s: float, dynamics: Dynamics) -> None:
        """Prepare a gate.

        Args:
            bounds: Limits to keep.
            braking: Deceleration that every joint can reach, (joints,), rad/s2.
            period_s: Time for which a torque acts, s.
            dynamics: Equation of motion of the arm.
        """
        low, high = bounds.position.T
        fastest = SPEED_FRACTION * bounds.velocity
        range_ends = low + RANGE_MARGIN_RAD, high - RANGE_MARGIN_RAD
        # In the row order of `is_clear`.
        self._limits = np.stack((bounds.torque, fastest, *range_ends, braking, dynamics.dry))
        self._torque, self._fastest, self._low, self._high, *_ = self._limits
        self._period_s = period_s
        self._dynamics = dynamics
        # Highest permitted speed towards an end of the range, (joints,), rad/s.
        self._limit_speed = partial(
            compute_stoppable_speed, fastest=fastest, braking=braking, period_s=period_s
        )
        self._is_clear = is_clear.load_machine_code()
        joints = len(braking)
        self._inertia = np.eye(joints)
        self._resisting = np.zeros(joints)
        self._unity = np.eye(joints)
        self._kinds = np.repeat(np.array([SOFT, HARD], dtype=np.int32), joints)

    def limit_torque(self, torque: Array, q: Array, qd: Array) -> tuple[Array, bool]:
        """Return the commanded torques, cut to the limits.

        Args:
            torque: Commanded torques, (joints,), N m. They must be finite.
            q: Positions, (joints,), rad.
            qd: Velocities, (joints,), rad/s.

        Returns:
            The permitted torques, and True if anything was cut.
        """
        self._dynamics.terms(q, qd)
        if self._is_clear(torque, self._dynamics.newest, self._limits, self._period_s):
            return torque, False
        passed: Array = np.clip(torque, -self._torque, self._torque)
        lowest_gain = -self._limit_speed(q - self._low, -qd) - qd
        highest_gain = self._limit_speed(self._high - q, qd) - qd
        gain = np.clip(self._predict_velocity_change(passed, q, qd), lowest_gain, highest_gain)
        # Light joints change speed so much within a cycle that its end must be predicted from the
        # state in the middle of the cycle.
        gain = self._predict_velocity_change(passed, q + 0.5 * self._period_s * qd, qd + 0.5 * gain)
        if (gain < lowest_gain).any() or (gain > highest_gain).any():
            passed = self._find_nearest_torque(gain, lowest_gain, highest_gain)
        return passed, not np.array_equal(passed, torque)

    def _predict_velocity_change(self, torque: Array, q: Array, qd: Array) -> Array:
        """Predict the change in velocity that torques cause in one cycle, (joints,), in rad/s."""
        self._inertia, bias = self._dynamics.terms(q, qd)
        self._resisting = bias + self._dynamics.friction(qd)
        return np.asarray(solve(self._inertia, torque - self._resisting) * self._period_s)

    def _find_nearest_torque(self, gain: Array, lowest_gain: Array, highest_gain: Array) -> Array:
        """Return the torques whose velocity change is as close to `gain` as the bounds permit.

        Args:
            gain: Desired velocity change in a cycle, (joints,), rad/s.
            lowest_gain: Lower bound of the change, rad/s.
            highest_gain: Upper bound of the change, rad/s.
        """
        scale = self._fastest
        per_torque = self._inertia * (scale / self._period_s) / self._torque[:, None]
        offset = self._resisting / self._torque
        upper = np.concatenate((highest_gain / scale, 1.0 - offset))
        lower = np.concatenate((lowest_gain / scale, -1.0 - offset))
        nearest, _, status, _ = daqp.solve(
            self._unity, -gain / scale, per_torque, upper, lower, self._kinds
        )
        if status < 0:
            nearest = np.clip(gain, lowest_gain, highest_gain) / scale
        return np.asarray(
            np.clip(
                (mat_vec(per_torque, nearest) + offset) * self._torque, -self._torque, self._torque
            )
        )


@compiled_for("f8[::1], f8[:,::1], f8[:,::1], f8")
def is_clear(
    torque: Array,
    evaluation: Array,
    limits: Array,
    period_s: float,
) -> bool:
    """Return True if a rough prediction shows that `torque` violates no limit.

    The velocity must stay within its bounds, with a margin, both if it does not change and if it
    changes by twice the predicted value. The margin covers the change of inertia and bias within a
    cycle. False does not imply that a limit would be violated.

    Args:
        torque: Commanded torques, (joints,), N m.
        evaluation: The state and its equation of motion, (3 + joints, joints); see `Dynamics`.
        limits: (6, joints): torque, speed, low and high end of the range, braking, dry friction.
        period_s: Time for which the torque acts, s.
    """
    q, qd, bias = evaluation[:INERTIA_ROW]
    inertia = evaluation[INERTIA_ROW:]
    most_torque, fastest, low, high, braking, dry = limits
    net_torque = torque - bias
    for joint in range(len(q)):
        if not abs(torque[joint]) <= most_torque[joint]:
            return False
        net_torque[joint] -= dry[joint] * math.tanh(qd[joint] / FRICTION_SPEED)
    twice = cholesky_solve(inertia, net_torque) * (2.0 * period_s)
    for joint in range(len(q)):
        speed = fastest[joint]
        deceleration = braking[joint]
        margin = CLEAR_SPEED_FRACTION * speed
        lowest = (
            -compute_stoppable_speed(
                q[joint] - low[joint], -qd[joint], speed, deceleration, period_s
            )
            - qd[joint]
            + margin
        )
        highest = (
            compute_stoppable_speed(
                high[joint] - q[joint], qd[joint], speed, deceleration, period_s
            )
            - qd[joint]
            - margin
        )
        if not (lowest <= 0.0 <= highest and lowest <= twice[joint] <= highest):
            return False
    return True


@compiled
def cholesky_solve(matrix: Array, vector: Array) -> Array:
    """Solve `matrix` x = `vector` like `rack.levels.algebra.solve`, for compiled callers."""
    size = len(vector)
    factor = np.zeros((size, size))
    solution = vector.copy()
    for row in range(size):
        for column in range(row + 1):
            remainder = matrix[row, column]
            for k in range(column):
                remainder -= factor[row, k] * factor[column, k]
            factor[row, column] = (
                np.sqrt(remainder) if row == column else remainder / factor[column, column]
            )
        for k in range(row):
            solution[row] -= factor[row, k] * solution[k]
        solution[row] /= factor[row, row]
    for row in range(size - 1, -1, -1):
        for k in range(row + 1, size):
            solution[row] -= factor[k, row] * solution[k]
        solution[row] /= factor[row, row]
    return solution


@compiled
def compute_stoppable_speed(
    distance: Array, speed: Array, fastest: Array, braking: Array, period_s: float
) -> Array:
    """Return the highest permitted speed towards an end of the range at the end of the cycle.

    If the speed changes from v to v' during the cycle T, the joint moves by (v + v') T / 2 and must
    be able to stop within the remaining distance: v'^2 / 2 a <= distance - (v + v') T / 2.

    Args:
        distance: Distance from the end of the range, rad.
        speed: Present speed towards the end of the range, rad/s.
        fastest: Maximum speed, rad/s.
        braking: Deceleration of the joint, rad/s2.
        period_s: Length of the cycle, s.
    """
    half = 0.5 * braking * period_s
    remaining = np.maximum(distance - 0.5 * speed * period_s, 0.0)
    stoppable = np.sqrt(half * half + 2.0 * braking * remaining) - half
    return np.minimum(stoppable, fastest)


MAX_ACCELERATION_FACTOR = 3.0
"""Multiple of the acceleration limits with which set points may change their velocity.

Curves between set points of the level above need a factor of two, joining the curves another one. A
smaller factor makes drives overshoot less.
"""


class SetPointGate:
    """Cuts set points so that an arm that follows them stays within its limits.

    The equation of motion gives the torques that move the arm from one set point to the next, and a
    `LimitGate` cuts them. Set points therefore stay within the range, have a velocity from which
    the arm can stop within the range, and change their velocity only as fast as the motors permit.
    A set point that is farther away is approached over several cycles. The motion starts from the
    sensed state for velocity set points, and from the last set point for position set points.
    """

    def __init__(self, arm: BrakedArm, bounds: Bounds, tick_s: float, last: Array) -> None:
        """Prepare a gate.

        Args:
            arm: The arm.
            bounds: Limits to keep.
            tick_s: Duration of a tick, s.
            last: Receives the last set point, (2, joints), rad and rad/s.
        """
        cell = arm.cell
        self._arm = arm
        self._tick_s = tick_s
        self._period_s = arm.every * tick_s
        self._braking = cell.limits.acceleration
        self._by_position = cell.interface == "position"
        narrowed = narrow_bounds(bounds, cell.limits)
        self._fastest = narrowed.velocity
        self._dynamics = Dynamics(cell)
        # A set point must be safe for this time, because later cycles may be missed.
        span_s = arm.patience * tick_s
        self._gate = LimitGate(narrowed, self._braking, span_s, self._dynamics)
        self._most_change = MAX_ACCELERATION_FACTOR * self._braking * self._period_s  # rad/s
        # No joint can reach a set point farther than this from its sensed position in a cycle.
        self._reach = self._fastest * self._period_s + cell.encoders.position_error
        self._last = last

    def limit_set_point(self, target: JointTarget, q: Array, qd: Array) -> JointTarget | Finding:
        """Return the set point, cut so that the arm stays within its limits.

        A set point is refused if a number is not finite, if a predicted torque is beyond its limit,
        or if it is the first set point and too far from the arm. A refusal engages the brakes.

        Args:
            target: Commanded set point.
            q: Sensed positions, (joints,), rad.
            qd: Sensed velocities, (joints,), rad/s.

        Returns:
            The permitted set point, or the finding with which it was refused.
        """
        arm = self._arm
        position, velocity = self._last
        if self._by_position:
            # Drives have continued to move while cycles were missed.
            position += max(arm.waited * self._tick_s - self._period_s, 0.0) * velocity
        else:
            position[:] = q
        refused = arm.refused(target.torque) or self._check_set_point(target, q, qd)
        if refused is not None:
            arm.brake()
            return refused
        wanted_velocity, is_cut = self._compute_approach(target)
        change = np.clip(wanted_velocity - velocity, -self._most_change, self._most_change)
        inertia, resisting = self._compute_resistance()
        torque = mat_vec(inertia, change / self._period_s) + resisting
        passed, was_cut = self._gate.limit_torque(torque, position, velocity)
        if was_cut:
            inertia, resisting = self._compute_resistance()
            change = self._period_s * solve(inertia, passed - resisting)
        arm.clipped += bool(is_cut or (change != wanted_velocity - velocity).any())
        position += self._period_s * (velocity + 0.5 * change)
        velocity += change
        return JointTarget(position.copy(), velocity.copy(), target.torque)

    def _check_set_point(self, target: JointTarget, q: Array, qd: Array) -> Finding | None:
        """Return a finding if a set point is not finite, or too far away for a first set point.

        While the arm is braked, and before the first set point, the sensed state takes the place of
        the last set point. The joints must be able to reach the new set point from it in one cycle.

        Returns:
            The finding. None if the set point is valid.
        """
        error = target.position - q
        is_invalid = ~np.isfinite(error + target.velocity)
        if self._arm.braked or np.isnan(self._last).any():
            self._last[:] = q, qd
            is_invalid |= np.abs(error) > self._reach
        if not is_invalid.any():
            return None
        joint = int(is_invalid.argmax())
        return self._arm.refuse_command(Finding(Alarm.SET_POINT, joint, float(error[joint])))

    def _compute_approach(self, target: JointTarget) -> tuple[Array, bool]:
        """Compute the velocity with which to approach a set point.

        Returns:
            The velocity for the end of the cycle, (joints,), rad/s, and True if the set point is
            too far away to be reached in one cycle.
        """
        if not self._by_position:
            return target.velocity, False
        position, velocity = self._last
        period_s = self._period_s
        missing = target.position - position - 0.5 * period_s * (velocity + target.velocity)
        distance = np.abs(missing)
        at_rest = np.zeros(len(distance))
        max_speed = compute_stoppable_speed(
            distance, at_rest, self._fastest, self._braking, period_s
        )
        closing = np.copysign(np.minimum(distance / period_s, max_speed), missing)
        # Within this distance `max_speed` does not limit `closing`.
        cut = (distance > self._braking * period_s**2).any()
        return target.velocity + closing, bool(cut)

    def _compute_resistance(self) -> tuple[Array, Array]:
        """Return the inertia, and the sum of bias and friction torques, at the last set point."""
        inertia, bias = self._dynamics.terms(*self._last)
        return inertia, bias + self._dynamics.friction(self._last[1])


def narrow_bounds(bounds: Bounds, limits: Limits) -> Bounds:
    """Return bounds halfway between `bounds` and the limits of planned motion.

    Where `limits` are wider than `bounds`, `bounds` apply. The margin allows for the overshoot of
    drives.
    """
    low, high = bounds.position.T
    planned_low, planned_high = 0.5 * (bounds.position + limits.position).T
    position = np.stack((np.maximum(low, planned_low), np.minimum(high, planned_high)), axis=1)
    fastest = np.minimum(bounds.velocity, 0.5 * (bounds.velocity + limits.velocity))
    return Bounds(position, fastest, bounds.torque)
