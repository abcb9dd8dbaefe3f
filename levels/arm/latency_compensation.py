"""Samples of an arm behind a bus are some ticks old, and count from elsewhere: its equation of
motion brings them to the present, `robot.calibration.offset` to the model's positions.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array, solve
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.drivable import JointTarget, Link, Sensed, copied
from rack.levels.level import Finding
from rack.levels.robot.dynamics import Dynamics


class Driven(NamedTuple):
    """What has driven an arm until a tick."""

    until: int
    torque: Array | None  # (joints,), N m; None: its brakes were engaged


class Present(NamedTuple):
    """A sample, and what it says of the present."""

    sample: Sensed  # as sensed
    state: Sensed  # as the model leads it on
    shown: (
        Sensed  # the same, but a joint whose sample has not changed stays: its sensor may be stuck
    )


def present_link(arm: BrakedArm, tick_s: float) -> Link:
    """Return the link to an arm through which samples are of the present: the arm, if they are."""
    encoders = arm.cell.encoders
    is_present = encoders.offset is None and not encoders.latency_ticks
    return arm if is_present else PresentLink(arm, tick_s)


class PresentLink:
    """Implements `Link` around an arm whose samples are up to `robot.latency_ticks` old, and off by
    `robot.calibration.offset`.

    Such a sample is led to the tick at which it is read: by the torques given since, or as brakes
    stop a joint. How far off the model may be by then is in the cell's `encoders`. An older sample
    is passed on as it is.
    """

    def __init__(self, arm: BrakedArm, tick_s: float) -> None:
        cell = arm.cell
        self._arm = arm
        self._offset = cell.encoders.offset
        self._braking = cell.limits.acceleration
        self._dynamics = Dynamics(cell)
        self._latency = cell.encoders.latency_ticks
        self._tick_s = tick_s
        self._driven: deque[Driven] = deque(maxlen=self._latency + 1)
        self._last: Present | None = None

    def sense(self) -> Sensed:
        """Return the newest sample, brought to the present."""
        return self.look().shown

    def look(self) -> Present:
        """Return the newest sample, and the present state."""
        arm = self._arm
        last = self._last
        sample = copied(arm.sense())
        if self._offset is not None:
            sample.position[:] += self._offset
        torque = None if arm.braked else arm.torque.copy()
        self._driven.append(Driven(arm.tick, torque))
        if not 0 < arm.tick - sample.tick <= self._latency:
            self._last = Present(sample, sample, sample)
            return self._last
        state = shown = self._led(sample)
        if last is not None and sample.tick != last.sample.tick:
            kept = sample.position == last.sample.position
            kept &= sample.velocity == last.sample.velocity
            shown = state._replace(
                position=np.where(kept, last.shown.position, state.position),
                velocity=np.where(kept, last.shown.velocity, state.velocity),
            )
        self._last = Present(sample, state, shown)
        return self._last

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on the torque; see `Link.drive`."""
        return self._arm.drive(torque, grip_force)

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Pass on the set points, as the drives count positions; see `Link.follow`."""
        if self._offset is not None:
            target = target._replace(position=target.position - self._offset)
        return self._arm.follow(target, grip_force)

    def _led(self, sample: Sensed) -> Sensed:
        """Return a sample led to the present."""
        led = copied(sample)._replace(tick=self._arm.tick)
        begun = sample.tick
        for until, torque in self._driven:
            if until > begun:
                self._pass(led.position, led.velocity, torque, (until - begun) * self._tick_s)
                begun = until
        return led

    def _pass(self, position: Array, velocity: Array, torque: Array | None, time_s: float) -> None:
        """Let time pass for a state."""
        if torque is None:
            change = -np.copysign(np.minimum(np.abs(velocity), time_s * self._braking), velocity)
        else:
            inertia, bias = self._dynamics.terms(position, velocity)
            friction = self._dynamics.friction(velocity)
            change = time_s * solve(inertia, torque - bias - friction)
        position += time_s * (velocity + 0.5 * change)
        velocity += change
