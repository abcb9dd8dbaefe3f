"""The set point of every servo cycle, interpolated between the set points of the level above.

A set point is to be reached at its `due` tick; the next one has arrived by then. In between, the
motion is the cubic Hermite curve through positions and velocities, so it is C1. If none arrives in
time, the motion ramps to rest; when set points resume, it joins them smoothly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.messages import ArmSetPoint
from rack.levels.robot.limits import Bounds, Limits
from rack.levels.servo.curves import Bridge, Curve, Decay, Motion, Passage, Ramp, set_motion

MAX_ACCELERATION = 2.0
"""Multiple of the acceleration limits that the curve between two set points may need: planned
motion, interpolated, needs a little more than 1."""
JOINING_SPEED_PART = 0.25
"""Part of the velocity limits that joining the set points may add to a motion."""
ASTRAY_RAD = 0.005
"""Distance from the reference beyond which an arm is led back gradually after missed cycles."""
MAX_AHEAD_S = 2.0
"""Time ahead at which a set point may be due: beyond that it is a broken command, not a slow
level."""


class SetPoint(NamedTuple):
    """Joint positions and velocities to be reached at a tick."""

    due: int  # tick
    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s


class Reference:
    """Interpolates set points: `take` takes them, and tick by tick `at(tick)` gives the motion
    wanted at that tick.
    """

    def __init__(self, bounds: Bounds, limits: Limits, tick_s: float) -> None:
        self._limits = limits
        self._tick_s = tick_s
        self._half_s = 0.5 * tick_s
        self._low, self._high = bounds.position.T.copy()
        self._fastest = bounds.velocity
        self._hardest = MAX_ACCELERATION * limits.acceleration
        joints = len(limits.velocity)
        self._motions = np.zeros(
            (2, 3, joints)
        )  # the one wanted, and its difference from the curve
        self._wanted = Motion(self._motions[0])
        self._interpolate = set_motion.load()
        self._command: ArmSetPoint | None = None  # the newest `JOINT_SET_POINT`
        self._offered = 0  # tick at which it is due
        self._due = 0  # tick at which the present curve ends
        self._next: SetPoint | None = None  # the set point to follow after that
        self.part = 1.0  # of full speed: of the motion of `to`, and of joining the set points
        self.goal: Array | None = (
            None  # (joints,), rad: goal of `to`, until another motion begins; None: none
        )
        self.holding = True  # no fresh set point
        self.refused = (
            0  # set points cut at the bounds, and cycles that saw one that is NaN or too far ahead
        )
        self.start(np.zeros(joints), np.zeros(joints), 0)

    def start(self, position: Array, velocity: Array, tick: int) -> None:
        """Start from a motion at `tick`, rad, rad/s: ramp to rest and hold."""
        self._curve: Curve = Ramp(position, velocity, self._limits.acceleration)
        self._from = tick
        self._difference: Curve | None = None  # from the arm's motion to the curve
        self.goal = None
        self.holding = True

    def meet(self, position: Array, velocity: Array, tick: int, astray: float = ASTRAY_RAD) -> None:
        """Start from where the arm is after missed cycles, if it has strayed as far as `astray`,
        rad, and lead it back to the set points.
        """
        now = self._motion(tick)
        if np.max(np.abs(now.position - position)) < astray:
            return
        if self.holding or tick >= self._due:
            self.start(position, velocity, tick)
        else:
            self._join(position, velocity, tick)

    def take(self, command: ArmSetPoint) -> None:
        """Take a new `JOINT_SET_POINT`. It must stay the newest message until the next one is
        taken.
        """
        self._command = command
        self._offered = command.due

    def at(self, tick: int) -> Motion:
        """Return the motion wanted at `tick`, by the set points taken; its acceleration is
        mid-cycle.
        """
        if self._next is not None and (self.holding or tick >= self._due):
            self._advance(self._next, tick)
        offered = self._offered
        waiting = self._next
        if tick < offered != self._due and (waiting is None or offered != waiting.due):
            self._receive(offered, tick)
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
        """Return the motion wanted at `tick` on the way to `goal` (joints,), rad, ignoring the
        level above.

        It ramps to rest, then goes straight, from rest to rest, within the limits of every joint.
        """
        if self.goal is goal:
            return self._motion(tick)
        now = self.rest(tick)
        if now.velocity.any():
            return now
        limits = self._limits
        fastest = self.part * limits.velocity
        hardest = self.part**2 * limits.acceleration
        self._curve = Passage(now.position, goal, fastest, hardest)
        self._from = tick
        self._difference = None
        self.goal = goal
        return self._motion(tick)

    def _receive(self, due: int, tick: int) -> None:
        """Copy the set point offered. It waits until the one before it is due: some protocols
        deliver early.
        """
        command = self._command
        if command is None:
            return
        position = np.clip(command.position, self._low, self._high)
        velocity = np.clip(command.velocity, -self._fastest, self._fastest)
        is_near = (due - tick) * self._tick_s <= MAX_AHEAD_S
        if is_near and np.isfinite((command.position, command.velocity)).all():
            self._next = SetPoint(due, position, velocity)
            is_cut = (position != command.position) | (velocity != command.velocity)
            self.refused += bool(is_cut.any())
        else:
            self.refused += 1
        if self._next is not None and (self.holding or tick >= self._due):
            self._advance(self._next, tick)

    def _advance(self, to: SetPoint, tick: int) -> None:
        """Begin the curve to the set point that waited: its time has come."""
        due, position, velocity = to
        self._next = None
        if due <= tick:
            return
        begin = tick if self.holding else self._due
        begin_s = (begin - self._from) * self._tick_s
        curve = Bridge(self._curve, begin_s, (position, velocity), (due - begin) * self._tick_s)
        if not self.holding and curve.is_within(self._hardest):
            self._curve = curve
            self._from = begin
            self._due = due
            if (
                self._difference is not None
                and (begin - self._differs_from) * self._tick_s >= self._difference.ends_s
            ):
                self._difference = None
            return
        now = self._motion(tick)
        left_s = (due - tick) * self._tick_s
        self._curve = Curve(position - velocity * left_s, velocity * left_s, duration_s=left_s)
        self._from = tick
        self._due = due
        self.holding = False
        self._join(now.position, now.velocity, tick)

    def _join(self, position: Array, velocity: Array, tick: int) -> None:
        """Let the difference between a motion at `tick` and the curve decay."""
        curve = self._curve.at((tick - self._from) * self._tick_s)
        fastest = JOINING_SPEED_PART * self.part * self._limits.velocity
        self._difference = Decay(
            position - curve.position, velocity - curve.velocity, fastest, self._limits.acceleration
        )
        self._differs_from = tick

    def _motion(self, tick: int) -> Motion:
        """Return the motion at `tick`, valid until the next call; its acceleration is mid-cycle."""
        curve = self._curve
        difference = self._difference
        wanted = self._wanted
        time_s = (tick - self._from) * self._tick_s
        half_s = self._half_s
        self._interpolate(curve.table, curve.duration_s, curve.ends_s, time_s, half_s, wanted.table)
        if difference is not None:
            time_s = (tick - self._differs_from) * self._tick_s
            lasts_s = difference.duration_s
            ends_s = difference.ends_s
            self._interpolate(difference.table, lasts_s, ends_s, time_s, half_s, self._motions[1])
            wanted.table += self._motions[1]
        return wanted
