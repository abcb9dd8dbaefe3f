"""The limit gates: on torques, and on set points for drives that follow position or velocity."""

from __future__ import annotations

import math

import daqp
import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, mat_vec, solve
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.drivable import JointTarget
from rack.levels.compiled import compiled, compiled_for
from rack.levels.level import Finding
from rack.levels.robot.dynamics import BIAS_ROW, FRICTION_SPEED, INERTIA_ROW, Dynamics
from rack.levels.robot.limits import Bounds, Limits

SPEED_PART = 0.99
"""Part of a velocity limit that the gate lets a joint reach; the rest covers model errors within a
cycle."""
RANGE_KEPT_RAD = 0.002
"""Distance that the gate keeps from the ends of a joint's range, for the same reason."""
CLEAR_PART = 0.01
"""Part of a velocity limit that must be left where one rough prediction is enough."""
HARD = 0
SOFT = 8
"""Kinds of the solver's constraints."""


class LimitGate:
    """Cuts torques so that the next cycle ends within limits, at a state from which the arm can
    still be stopped.

    A joint may be only so fast that it can brake, with `braking` (joints,), rad/s2, before the end
    of its range. The arm's equation of motion predicts the velocities. Torques that lead too far
    are replaced by the nearest ones, in acceleration, that do not: a small quadratic program, in
    which torque limits take precedence. Far from all limits, nearly always, one rough prediction
    shows that nothing is to be cut.
    """

    def __init__(self, bounds: Bounds, braking: Array, period_s: float, dynamics: Dynamics) -> None:
        low, high = bounds.position.T
        fastest = SPEED_PART * bounds.velocity
        kept = low + RANGE_KEPT_RAD, high - RANGE_KEPT_RAD
        # The rows of `is_clear`.
        self._limits = np.stack((bounds.torque, fastest, *kept, braking, dynamics.dry))
        self._torque, self._fastest, self._low, self._high, self._braking, _ = self._limits
        self._period_s = period_s
        self._dynamics = dynamics
        self._is_clear = is_clear.load()
        joints = len(braking)
        self._inertia = np.eye(joints)
        self._resisting = np.zeros(joints)
        self._unity = np.eye(joints)
        self._kinds = np.repeat(np.array([SOFT, HARD], dtype=np.int32), joints)

    def admit(self, torque: Array, q: Array, qd: Array) -> tuple[Array, bool]:
        """Return the torques (joints,), N m, that may pass at state `q`, `qd`, and whether anything
        was cut.

        `torque` must be finite.
        """
        self._dynamics.terms(q, qd)
        if self._is_clear(torque, self._dynamics.newest, self._limits, self._period_s):
            return torque, False
        passed: Array = np.clip(torque, -self._torque, self._torque)
        least = -self._speed_towards(q - self._low, -qd) - qd
        most = self._speed_towards(self._high - q, qd) - qd
        gain = np.clip(self._gain(passed, q, qd), least, most)
        # Light joints change speed so much within a cycle that only its middle predicts where it
        # ends.
        gain = self._gain(passed, q + 0.5 * self._period_s * qd, qd + 0.5 * gain)
        if (gain < least).any() or (gain > most).any():
            passed = self._nearest(gain, least, most)
        return passed, not np.array_equal(passed, torque)

    def _gain(self, torque: Array, q: Array, qd: Array) -> Array:
        """Return the change in velocity, rad/s, that torques cause in one cycle at state `q`,
        `qd`.
        """
        self._inertia, bias = self._dynamics.terms(q, qd)
        self._resisting = bias + self._dynamics.friction(qd)
        return np.asarray(solve(self._inertia, torque - self._resisting) * self._period_s)

    def _nearest(self, gain: Array, least: Array, most: Array) -> Array:
        """Return the torques whose gain in velocity, rad/s a cycle, is nearest to `gain` between
        `least` and `most`.
        """
        scale = self._fastest
        per_torque = self._inertia * (scale / self._period_s) / self._torque[:, None]
        offset = self._resisting / self._torque
        upper = np.concatenate((most / scale, 1.0 - offset))
        lower = np.concatenate((least / scale, -1.0 - offset))
        nearest, _, status, _ = daqp.solve(
            self._unity, -gain / scale, per_torque, upper, lower, self._kinds
        )
        if status < 0:
            nearest = np.clip(gain, least, most) / scale
        return np.asarray(
            np.clip(
                (mat_vec(per_torque, nearest) + offset) * self._torque, -self._torque, self._torque
            )
        )

    def _speed_towards(self, distance: Array, speed: Array) -> Array:
        return speed_towards(distance, speed, self._fastest, self._braking, self._period_s)


@compiled_for("f8[::1], f8[:,::1], f8[:,::1], f8")
def is_clear(
    torque: Array,
    evaluation: Array,  # of the equation of motion: (3 + joints, joints)
    # (6, joints): torque, speed, low and high end of the range, braking, dry friction
    limits: Array,
    period_s: float,
) -> bool:
    """Return whether `torque` leads nowhere near a limit, by the equation of motion at the state of
    `evaluation`.

    It does not if the velocity stays within its bounds at no gain as at twice the gain predicted,
    with some room: more than inertia and bias change in a cycle.
    """
    q = evaluation[0]
    qd = evaluation[1]
    bias = evaluation[BIAS_ROW]
    inertia = evaluation[INERTIA_ROW:]
    most_torque, fastest, low, high, braking, dry = limits
    left = torque - bias
    for joint in range(len(q)):
        if not abs(torque[joint]) <= most_torque[joint]:
            return False
        left[joint] -= dry[joint] * math.tanh(qd[joint] / FRICTION_SPEED)
    twice = cholesky_solve(inertia, left) * (2.0 * period_s)
    for joint in range(len(q)):
        speed = fastest[joint]
        hard = braking[joint]
        room = CLEAR_PART * fastest[joint]
        least = (
            -speed_towards(q[joint] - low[joint], -qd[joint], speed, hard, period_s)
            - qd[joint]
            + room
        )
        most = (
            speed_towards(high[joint] - q[joint], qd[joint], speed, hard, period_s)
            - qd[joint]
            - room
        )
        if not (least <= 0.0 <= most and least <= twice[joint] <= most):
            return False
    return True


@compiled
def cholesky_solve(matrix: Array, vector: Array) -> Array:
    """Return the same as `rack.levels.algebra.solve`, to compiled callers."""
    size = len(vector)
    factor = np.zeros((size, size))
    solution = vector.copy()
    for row in range(size):
        for column in range(row + 1):
            rest = matrix[row, column]
            for k in range(column):
                rest -= factor[row, k] * factor[column, k]
            factor[row, column] = np.sqrt(rest) if row == column else rest / factor[column, column]
        for k in range(row):
            solution[row] -= factor[row, k] * solution[k]
        solution[row] /= factor[row, row]
    for row in range(size - 1, -1, -1):
        for k in range(row + 1, size):
            solution[row] -= factor[k, row] * solution[k]
        solution[row] /= factor[row, row]
    return solution


@compiled
def speed_towards(
    distance: Array, speed: Array, fastest: Array, braking: Array, period_s: float
) -> Array:
    """Return the highest speed, at the end of the cycle, towards an end of the range that is
    `distance` away.

    With v' at the end of the cycle the joint has come (v + v') T / 2 nearer, and must stop within
    the rest: v'^2 / 2 a <= distance - (v + v') T / 2.
    """
    half = 0.5 * braking * period_s
    left = np.maximum(distance - 0.5 * speed * period_s, 0.0)
    stoppable = np.sqrt(half * half + 2.0 * braking * left) - half
    return np.minimum(stoppable, fastest)


MOST_ACCELERATION = 3.0
"""Multiple of the acceleration limits with which set points may change their velocity: curves
between those of the level above need two, joining them another. The less, the less drives swing
over."""


class SetPointGate:
    """Cuts set points so that an arm that follows them stays within its limits, as `LimitGate` does
    with torques.

    The way from one set point to the next takes torques, by the equation of motion: these pass a
    `LimitGate`. So set points stay within the range, at a velocity from which the arm can still be
    stopped in it, and change their velocity only as fast as the motors can. One that is farther
    away is approached, and left behind until then. Set points of velocity begin where the arm is
    sensed, those of position where the last one was.
    """

    def __init__(
        self, arm: BrakedArm, bounds: Bounds, tick_s: float, span_s: float, last: Array
    ) -> None:
        """Keep `bounds` for `span_s`, as later cycles may be missed; `last`, (2, joints), rad,
        rad/s, is room for the last set point.
        """
        cell = arm.cell
        self._arm = arm
        self._tick_s = tick_s
        self._period_s = arm.every * tick_s
        self._braking = cell.limits.acceleration
        self._by_position = cell.interface == "position"
        kept = half_planned(bounds, cell.limits)
        self._fastest = kept.velocity
        self._dynamics = Dynamics(cell)
        self._gate = LimitGate(kept, self._braking, span_s, self._dynamics)
        self._most = MOST_ACCELERATION * self._braking * self._period_s  # rad/s
        # A set point that no joint can reach in a cycle from where it is sensed.
        self._reach = self._fastest * self._period_s + cell.encoders.off
        self._last = last

    def admit(self, target: JointTarget, q: Array, qd: Array) -> JointTarget | Finding:
        """Return the set point that may pass to the arm, sensed at `q`, `qd`; or why none may: the
        brakes are engaged.

        Refused are numbers that are not finite, a predicted torque beyond its limit, and a first
        set point that is not where the arm is.
        """
        arm = self._arm
        position, velocity = self._last
        if self._by_position:
            # Drives have gone on while cycles were missed.
            position += max(arm.waited * self._tick_s - self._period_s, 0.0) * velocity
        else:
            position[:] = q
        refused = arm.refused(target.torque) or self._misplaced(target, q, qd)
        if refused is not None:
            arm.brake()
            return refused
        wanted, is_cut = self._approached(target)
        change = np.clip(wanted - velocity, -self._most, self._most)
        inertia, resisting = self._resisting()
        torque = mat_vec(inertia, change / self._period_s) + resisting
        passed, was_cut = self._gate.admit(torque, position, velocity)
        if was_cut:
            inertia, resisting = self._resisting()
            change = self._period_s * solve(inertia, passed - resisting)
        arm.clipped += bool(is_cut or (change != wanted - velocity).any())
        position += self._period_s * (velocity + 0.5 * change)
        velocity += change
        return JointTarget(position.copy(), velocity.copy(), target.torque)

    def _misplaced(self, target: JointTarget, q: Array, qd: Array) -> Finding | None:
        """Begin where the arm is, unless it follows; return what is wrong with a set point."""
        away = target.position - q
        wrong = ~np.isfinite(away + target.velocity)
        if self._arm.braked or np.isnan(self._last).any():
            self._last[:] = q, qd
            wrong |= np.abs(away) > self._reach
        if not wrong.any():
            return None
        joint = int(wrong.argmax())
        return self._arm.refuse(Finding(Alarm.SET_POINT, joint, float(away[joint])))

    def _approached(self, target: JointTarget) -> tuple[Array, bool]:
        """Return the velocity at the end of the cycle, rad/s, and whether the set point stays
        farther away than a cycle's motion makes up for.
        """
        if not self._by_position:
            return target.velocity, False
        position, velocity = self._last
        period_s = self._period_s
        missing = target.position - position - 0.5 * period_s * (velocity + target.velocity)
        distance = np.abs(missing)
        at_rest = np.zeros(len(distance))
        most = speed_towards(distance, at_rest, self._fastest, self._braking, period_s)
        closing = np.copysign(np.minimum(distance / period_s, most), missing)
        # Up to there `most` is not the lesser of the two.
        cut = (distance > self._braking * period_s**2).any()
        return target.velocity + closing, bool(cut)

    def _resisting(self) -> tuple[Array, Array]:
        """Return inertia and resisting torques at the last set point."""
        inertia, bias = self._dynamics.terms(*self._last)
        return inertia, bias + self._dynamics.friction(self._last[1])


def half_planned(bounds: Bounds, limits: Limits) -> Bounds:
    """Return bounds half way from those given to the limits of planned motion, where these are
    tighter: drives swing over a little.
    """
    low, high = bounds.position.T
    least, most = 0.5 * (bounds.position + limits.position).T
    position = np.stack((np.maximum(low, least), np.minimum(high, most)), axis=1)
    fastest = np.minimum(bounds.velocity, 0.5 * (bounds.velocity + limits.velocity))
    return Bounds(position, fastest, bounds.torque)
