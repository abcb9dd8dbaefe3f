"""Drives that follow set points of position or velocity: what such set points must pass."""

from __future__ import annotations

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, mat_vec, solve
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.drivable import JointTarget
from rack.levels.arm.drives import LimitGate, speed_towards
from rack.levels.level import Finding
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import Bounds, Limits

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
        rad/s, is room for the last set point."""
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
        farther away than a cycle's motion makes up for."""
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
    tighter: drives swing over a little."""
    low, high = bounds.position.T
    least, most = 0.5 * (bounds.position + limits.position).T
    position = np.stack((np.maximum(low, least), np.minimum(high, most)), axis=1)
    fastest = np.minimum(bounds.velocity, 0.5 * (bounds.velocity + limits.velocity))
    return Bounds(position, fastest, bounds.torque)
