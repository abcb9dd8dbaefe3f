"""Guard of an arm that does not keep its limits itself: checks samples and limits commands."""

from __future__ import annotations

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.drives import LimitGate, SetPointGate
from rack.levels.arm.latency_compensation import PresentLink
from rack.levels.arm.link import DriveState, JointTarget, LimitViolation, Link, Sensed
from rack.levels.errors import RobotError
from rack.levels.level import Finding
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import Bounds


def narrow_bounds_by_errors(cell: Cell, speed_fraction: float) -> Bounds:
    """Return the bounds of a cell, narrowed by the error of the encoders.

    `speed_fraction` is the fraction of the velocity limits that is permitted.

    Raises:
        RobotError: The encoders are too coarse to detect a violated limit.
    """
    velocity = speed_fraction * cell.bounds.velocity
    off = cell.encoders.position_error
    speed_off = cell.encoders.velocity_error
    bounds = Bounds(
        position=cell.bounds.position + np.stack((off, -off), axis=1),
        velocity=velocity - speed_off,
        torque=cell.bounds.torque,
    )
    coarse = (bounds.velocity <= speed_off) | (bounds.position[:, 0] >= bounds.position[:, 1])
    if coarse.any():
        joint = int(coarse.argmax())
        name = "latency_ticks" if cell.encoders.latency_ticks else "sensors"
        raise RobotError(
            f"robot.{name}: '{cell.joints[joint]}' may be off by {off[joint]:g} rad,"
            f" {speed_off[joint]:g} rad/s, which is too coarse to keep it below"
            f" {velocity[joint]:g} rad/s; it must be less than half of that"
        )
    return bounds


class GuardedArm:
    """Implements `Link` around an arm, and protects it, using only its samples.

    A torque that is not finite, or beyond its limit, is refused and engages the brakes. Other
    torques are cut so that the arm stays within the limits and can still be stopped (`LimitGate`).
    Later cycles may be missed, so the limits must hold for the whole time for which the motors may
    keep applying the torque (the arm's patience). Each limit has a margin for the largest error of
    the encoders. A sample that exceeds a limit by more than that error, or is not finite, is a
    violation. It is counted, stored in the arm's `exceeded`, and stops the arm. Contacts and true
    positions are not checked, because only a simulation knows them.
    """

    def __init__(
        self, arm: BrakedArm, tick_s: float, below: Link | None = None, speed_fraction: float = 1.0
    ) -> None:
        """Guard an arm.

        Args:
            arm: The arm.
            tick_s: Duration of a tick, s.
            below: Link that senses the arm. None if the arm is sensed directly.
            speed_fraction: Fraction of the velocity limits that is permitted.

        Raises:
            RobotError: The encoders are too coarse to detect a violated limit.
        """
        self._arm = arm
        self._below: Link = below or arm
        self._cell = cell = arm.cell
        self._tick_s = tick_s
        self._span_s = arm.patience * tick_s
        self._last_set_point: Array = np.full((2, len(cell.dof)), np.nan)
        self._dynamics = Dynamics(cell)
        self._state: Sensed | None = None
        self.permit_speed(speed_fraction)

    def permit_speed(self, speed_fraction: float) -> None:
        """Set the fraction of the velocity limits that the guard permits.

        Raises:
            RobotError: The encoders are too coarse to detect a violated limit.
        """
        cell = self._cell
        bounds = narrow_bounds_by_errors(cell, speed_fraction)
        off = cell.encoders.position_error
        self._low = cell.bounds.position[:, 0] - off
        self._high = cell.bounds.position[:, 1] + off
        self._fastest = speed_fraction * cell.bounds.velocity + cell.encoders.velocity_error
        self._gate = LimitGate(bounds, cell.limits.acceleration, self._span_s, self._dynamics)
        if cell.interface != "torque":
            self._set_points = SetPointGate(self._arm, bounds, self._tick_s, self._last_set_point)

    def sense(self) -> Sensed:
        """Return the newest sample, after checking it against the limits."""
        if isinstance(self._below, PresentLink):
            _, state, sample = self._below.estimate_present()
        else:
            state = sample = self._below.sense()
        is_new = self._state is None or state.tick != self._state.tick
        self._state = state
        if is_new:
            self._check_sample(state)
        return sample

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on the torque, (joints,), N m, cut to the limits; see `Link.drive`."""
        arm = self._arm
        refused = arm.refused(torque) or (arm.exceeded and arm.exceeded.finding)
        if refused is not None:
            arm.brake()
            return refused
        state = self._state
        assert state is not None, "the arm is sensed before it is driven"
        torque, cut = self._gate.limit_torque(torque, state.position, state.velocity)
        arm.clipped += cut
        return arm.drive(torque, grip_force)

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Pass on the set points, cut to the limits by `SetPointGate`; see `Link.follow`."""
        if self._arm.exceeded is not None:
            self._arm.brake()
            return self._arm.exceeded.finding
        state = self._state
        assert state is not None, "the arm is sensed before it is driven"
        passed = self._set_points.limit_set_point(target, state.position, state.velocity)
        return passed if isinstance(passed, Finding) else self._below.follow(passed, grip_force)

    def _check_sample(self, sample: Sensed) -> None:
        """Set the arm's `exceeded` to the limit that a sample exceeds, or to None.

        A violation while the drives are enabled is counted and reported.
        """
        q = sample.position
        # The conditions are negated so that NaN counts as a violation.
        is_outside = ~((q >= self._low) & (q <= self._high))
        is_too_fast = ~(np.abs(sample.velocity) <= self._fastest)
        if not (is_outside.any() or is_too_fast.any()):
            self._arm.exceeded = None
            return
        joint = int((is_outside | is_too_fast).argmax())
        if is_outside[joint]:
            value = float(q[joint])
            permitted = f"{self._low[joint]:g} to {self._high[joint]:g} rad"
            quantity = f"position {value:.4g} rad"
        else:
            value = float(sample.velocity[joint])
            permitted = f"up to {self._fastest[joint]:g} rad/s"
            quantity = f"velocity {value:.4g} rad/s"
        text = f"{quantity} of joint '{self._cell.joints[joint]}' as sensed; permitted: {permitted}"
        arm = self._arm
        finding = Finding(Alarm.LIMIT_EXCEEDED, joint, value)
        # An arm whose drives are not enabled may be moved by hand.
        if arm.state is DriveState.ENABLED:
            arm.violations += 1
            arm.first_violation = arm.first_violation or f"{text}, at tick {sample.tick}"
            arm.report_finding(finding)
            arm.brake_cause = Error.LIMIT
        arm.exceeded = LimitViolation(finding, text)
