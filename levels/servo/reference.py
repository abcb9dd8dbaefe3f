"""The set point of every servo cycle, interpolated between the set points of the level above.

A set point is to be reached at its `due` tick; the next one has arrived by then. In between, the motion is the cubic
Hermite curve through positions and velocities, so it is C1. If none arrives in time, the motion ramps to rest; when set
points resume, it joins them smoothly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.robot.limits import Bounds, Limits
from rack.levels.servo.curves import Curve, Decay, Hermite, Motion, Passage, Ramp

MAX_ACCELERATION = 2.0
"""Multiple of the acceleration limits that the curve between two set points may need: planned motion, interpolated,
needs a little more than 1."""
JOINING_SPEED_PART = 0.25
"""Part of the velocity limits that joining the set points may add to a motion."""
ASTRAY_RAD = 0.005
"""Distance from the reference beyond which an arm is led back gradually after missed cycles."""
MAX_AHEAD_S = 2.0
"""Time ahead at which a set point may be due: beyond that it is a broken command, not a slow level."""


class SetPoint(NamedTuple):
    """Joint positions and velocities to be reached at a tick."""

    due: int  # tick
    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s


class Reference:
    """Interpolates set points: tick by tick, `at(command, tick)` gives the motion wanted at that tick."""

    def __init__(self, bounds: Bounds, limits: Limits, tick_s: float) -> None:
        self._bounds, self._limits, self._tick_s = bounds, limits, tick_s
        joints = len(limits.velocity)
        self._nothing = Decay(np.zeros(joints), np.zeros(joints), limits.velocity, limits.acceleration)
        self._due = 0  # tick at which the present curve ends
        self._next: SetPoint | None = None  # the set point to follow after that
        self.goal: Array | None = None  # (joints,), rad: goal of `to`, until another motion begins; None: none
        self.holding = True  # no fresh set point
        self.refused = 0  # set points cut at the bounds, and cycles that saw one that is NaN or too far ahead
        self.start(np.zeros(joints), np.zeros(joints), 0)

    def start(self, position: Array, velocity: Array, tick: int) -> None:
        """Start from a motion at `tick`, rad, rad/s: ramp to rest and hold."""
        self._curve: Curve = Ramp(position.copy(), velocity.copy(), self._limits.acceleration)
        self._from = tick
        self._difference, self._differs_from = self._nothing, tick
        self.goal = None
        self.holding = True

    def meet(self, position: Array, velocity: Array, tick: int) -> None:
        """Start from where the arm is after missed cycles, if it has strayed, and lead it back to the set points."""
        now = self._motion(tick)
        if np.max(np.abs(now.position - position)) < ASTRAY_RAD:
            return
        if self.holding or tick >= self._due:
            self.start(position, velocity, tick)
        else:
            self._join(position, velocity, tick)

    def at(self, command: Message, tick: int) -> Motion:
        """Return the motion wanted at `tick`, given the newest `JOINT_SET_POINT`; its acceleration is mid-cycle."""
        self._advance(tick)
        due, waiting = command.due, self._next
        if tick < due != self._due and (waiting is None or due != waiting.due):
            self._receive(command, due, tick)
            self._advance(tick)
        if not self.holding and tick >= self._due:
            last = self._motion(self._due)
            self.start(last.position, last.velocity, self._due)
        return self._motion(tick)

    def rest(self, tick: int) -> Motion:
        """Return the motion wanted at `tick`, ignoring the level above: ramp to rest and hold."""
        self._next = None
        if not self.holding or self.goal is not None:
            now = self._motion(tick)
            self.start(now.position, now.velocity, tick)
        return self._motion(tick)

    def to(self, goal: Array, tick: int) -> Motion:
        """Return the motion wanted at `tick` on the way to `goal` (joints,), rad, ignoring the level above.

        It ramps to rest, then goes straight, from rest to rest, within the limits of every joint.
        """
        if self.goal is goal:
            return self._motion(tick)
        now = self.rest(tick)
        if now.velocity.any():
            return now
        limits = self._limits
        self._curve, self._from = Passage(now.position, goal, limits.velocity, limits.acceleration), tick
        self._difference, self.goal = self._nothing, goal
        return self._motion(tick)

    def _receive(self, command: Message, due: int, tick: int) -> None:
        """Copy a set point. It waits until the one before it is due: some protocols deliver early."""
        finite = bool(np.isfinite(command.position).all() and np.isfinite(command.velocity).all())
        if not finite or (due - tick) * self._tick_s > MAX_AHEAD_S:
            self.refused += 1
            return
        position = np.clip(command.position, self._bounds.position[:, 0], self._bounds.position[:, 1])
        velocity = np.clip(command.velocity, -self._bounds.velocity, self._bounds.velocity)
        self.refused += not (np.array_equal(position, command.position) and np.array_equal(velocity, command.velocity))
        self._next = SetPoint(due, position, velocity)

    def _advance(self, tick: int) -> None:
        """Begin the curve to the waiting set point when its time has come."""
        if self._next is None or (not self.holding and tick < self._due):
            return
        (due, position, velocity), self._next = self._next, None
        if due <= tick:
            return
        now = self._motion(tick)
        begin = tick if self.holding else self._due
        curve = self._bridge(begin, position, velocity, due)
        joined = not self.holding and bool((curve.hardest() <= MAX_ACCELERATION * self._limits.acceleration).all())
        self._due, self.holding = due, False
        if joined:
            self._curve, self._from = curve, begin
            return
        left_s = (due - tick) * self._tick_s
        self._curve, self._from = Hermite(position - velocity * left_s, velocity, position, velocity, left_s), tick
        self._join(now.position, now.velocity, tick)

    def _bridge(self, begin: int, position: Array, velocity: Array, due: int) -> Hermite:
        """Return the curve from the present one at tick `begin` to a set point."""
        start = self._curve.at((begin - self._from) * self._tick_s)
        return Hermite(start.position, start.velocity, position, velocity, (due - begin) * self._tick_s)

    def _join(self, position: Array, velocity: Array, tick: int) -> None:
        """Let the difference between a motion at `tick` and the curve decay."""
        curve = self._curve.at((tick - self._from) * self._tick_s)
        fastest = JOINING_SPEED_PART * self._limits.velocity
        self._difference = Decay(
            position - curve.position, velocity - curve.velocity, fastest, self._limits.acceleration
        )
        self._differs_from = tick

    def _motion(self, tick: int) -> Motion:
        """Return the motion at `tick`; the acceleration is that of the middle of the coming cycle."""
        curve_s = (tick - self._from) * self._tick_s
        differs_s = (tick - self._differs_from) * self._tick_s
        half_s = 0.5 * self._tick_s
        curve, difference = self._curve.at(curve_s), self._difference.at(differs_s)
        ahead, apart = self._curve.at(curve_s + half_s), self._difference.at(differs_s + half_s)
        return Motion(
            curve.position + difference.position,
            curve.velocity + difference.velocity,
            ahead.acceleration + apart.acceleration,
        )
