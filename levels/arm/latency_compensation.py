"""Conversion of delayed samples to the present state of the arm.

Samples of an arm behind a bus are some ticks old. The arm's equation of motion extrapolates them to
the present. `robot.calibration.offset` converts them to positions of the model.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array, solve
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.link import JointTarget, Sensed, copy_sample
from rack.levels.level import Finding
from rack.levels.robot.dynamics import Dynamics


class AppliedTorque(NamedTuple):
    """Torque that has driven an arm until a tick."""

    until: int  # tick
    torque: Array | None  # (joints,), N m. None if its brakes were engaged


class PresentState(NamedTuple):
    """A sample and the present state derived from it."""

    sample: Sensed  # as sensed
    state: Sensed  # extrapolated to the present
    # Like `state`, but a joint whose sample has not changed keeps its last value, because its
    # sensor may be stuck.
    reported: Sensed


class PresentLink:
    """Implements `Link` around an arm with delayed samples or an offset of positions.

    Samples are up to `robot.latency_ticks` old, and `robot.calibration.offset` is added to them. A
    sample is extrapolated to the tick at which it is read, using the torques applied since it was
    taken, or the deceleration of the brakes. The cell's `encoders` include the largest error of the
    extrapolation. A sample that is older than the latency is passed on without extrapolation.
    """

    def __init__(self, arm: BrakedArm, tick_s: float) -> None:
        cell = arm.cell
        self._arm = arm
        self._offset = cell.encoders.offset
        self._braking = cell.limits.acceleration
        self._dynamics = Dynamics(cell)
        self._latency = cell.encoders.latency_ticks
        self._tick_s = tick_s
        self._driven: deque[AppliedTorque] = deque(maxlen=self._latency + 1)
        self._last: PresentState | None = None

    def sense(self) -> Sensed:
        """Return the newest sample, extrapolated to the present."""
        return self.estimate_present().reported

    def estimate_present(self) -> PresentState:
        """Return the newest sample, and the present state estimated from it."""
        arm = self._arm
        last = self._last
        sample = copy_sample(arm.sense())
        if self._offset is not None:
            sample.position[:] += self._offset
        torque = None if arm.braked else arm.torque.copy()
        self._driven.append(AppliedTorque(arm.tick, torque))
        if not 0 < arm.tick - sample.tick <= self._latency:
            self._last = PresentState(sample, sample, sample)
            return self._last
        state = shown = self._extrapolate(sample)
        if last is not None and sample.tick != last.sample.tick:
            is_stuck = sample.position == last.sample.position
            is_stuck &= sample.velocity == last.sample.velocity
            shown = state._replace(
                position=np.where(is_stuck, last.reported.position, state.position),
                velocity=np.where(is_stuck, last.reported.velocity, state.velocity),
            )
        self._last = PresentState(sample, state, shown)
        return self._last

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on the torque; see `Link.drive`."""
        return self._arm.drive(torque, grip_force)

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Pass on the set points, converted to the drives' positions; see `Link.follow`."""
        if self._offset is not None:
            target = target._replace(position=target.position - self._offset)
        return self._arm.follow(target, grip_force)

    def _extrapolate(self, sample: Sensed) -> Sensed:
        """Return a copy of a sample, extrapolated to the present tick."""
        led = copy_sample(sample)._replace(tick=self._arm.tick)
        begun = sample.tick
        for until, torque in self._driven:
            if until > begun:
                self._advance_state(
                    led.position, led.velocity, torque, (until - begun) * self._tick_s
                )
                begun = until
        return led

    def _advance_state(
        self, position: Array, velocity: Array, torque: Array | None, time_s: float
    ) -> None:
        """Advance a state by `time_s`, in place.

        Args:
            position: (joints,), rad.
            velocity: (joints,), rad/s.
            torque: (joints,), N m. None if the brakes were engaged.
            time_s: Duration, s.
        """
        if torque is None:
            change = -np.copysign(np.minimum(np.abs(velocity), time_s * self._braking), velocity)
        else:
            inertia, bias = self._dynamics.terms(position, velocity)
            change = time_s * solve(inertia, torque - bias - self._dynamics.friction(velocity))
        position += time_s * (velocity + 0.5 * change)
        velocity += change
