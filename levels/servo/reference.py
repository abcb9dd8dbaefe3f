"""Interpolates the set points of the level above for every servo cycle.

A set point is to be reached at its `due` tick, and the next one should arrive before that. In
between, the motion is the cubic Hermite curve through positions and velocities. If no
set point arrives in time, the motion ramps to rest; when set points resume, it joins them smoothly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.messages import ArmSetPoint
from rack.levels.robot.limits import Bounds, Limits
from rack.levels.servo.curves import Bridge, Curve, Decay, Motion, Passage, Ramp, set_motion

MAX_ACCELERATION = 2.0
"""Multiple of the acceleration limits that the curve between two set points may need. Interpolation
of a planned motion needs a little more than 1."""
JOINING_SPEED_PART = 0.25
"""Part of the velocity limits that the transition to the set points may add to their motion."""
ASTRAY_RAD = 0.005
"""Distance from the wanted motion at which it restarts from the arm after missed cycles."""
MAX_AHEAD_S = 2.0
"""Largest time until a set point is due. A set point that is due later counts as invalid."""


class SetPoint(NamedTuple):
    """Joint positions and velocities to be reached at a tick."""

    due: int  # tick
    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s


class Reference:
    """Interpolates set points.

    `take_command` accepts a set point; `compute_motion` returns the motion wanted at a tick.

    Attributes:
        speed_scale: Fraction of full speed, up to 1, for the motion of `move_to` and for joining
            the set points.
        goal: Goal of `move_to`, (joints,), rad, until another motion begins, else None.
        holding: True if no set point is followed. The motion then ramps to rest or is at rest.
        refused: Number of set points cut at the bounds, and of cycles in which one is NaN or due
            too far ahead.
    """

    def __init__(self, bounds: Bounds, limits: Limits, tick_s: float) -> None:
        """Start at rest at zero positions.

        Args:
            bounds: Bounds at which set points are cut.
            limits: Limits for motions that the reference makes itself.
            tick_s: Duration of a tick.
        """
        self._limits = limits
        self._tick_s = tick_s
        self._bounds = bounds
        joints = len(limits.velocity)
        # The wanted motion, and its difference from the curve.
        self._motions = np.zeros((2, 3, joints))
        self._wanted = Motion(self._motions[0])
        self._interpolate = set_motion.load_machine_code()
        self._command: ArmSetPoint | None = None  # the newest set point
        self._offered = 0  # tick at which that set point is due
        self._due = 0  # tick at which the present curve ends
        self._next: SetPoint | None = None  # set point to follow after that tick
        self.speed_scale = 1.0
        self.goal: Array | None = None
        self.holding = True
        self.refused = 0
        self.start(np.zeros(joints), np.zeros(joints), 0)

    def start(self, position: Array, velocity: Array, tick: int) -> None:
        """Restart from a position and velocity: ramp to rest, then hold.

        Args:
            position: Position at `tick`, (joints,), rad.
            velocity: Velocity at `tick`, (joints,), rad/s.
            tick: Tick at which the ramp begins.
        """
        self._curve: Curve = Ramp(position, velocity, self._limits.acceleration)
        self._from = tick
        self._difference: Curve | None = None  # from the arm's motion to the curve
        self.goal = None
        self.holding = True

    def restart_if_astray(
        self, position: Array, velocity: Array, tick: int, tolerance_rad: float = ASTRAY_RAD
    ) -> None:
        """After missed cycles, restart from the arm's position if it is too far from the motion.

        From there the motion joins the present curve smoothly, or ramps to rest if there is none.

        Args:
            position: Sensed positions, (joints,), rad.
            velocity: Sensed velocities, (joints,), rad/s.
            tick: Tick of the sample.
            tolerance_rad: Distance from the motion at which a joint counts as too far away.
        """
        now = self._evaluate_motion(tick)
        if np.max(np.abs(now.position - position)) < tolerance_rad:
            return
        if self.holding or tick >= self._due:
            self.start(position, velocity, tick)
        else:
            self._begin_decay(position, velocity, tick)

    def take_command(self, command: ArmSetPoint) -> None:
        """Accept a new set point.

        It is copied later, so the message must remain valid until the next call of this method.

        Args:
            command: Message with the set point.
        """
        self._command = command
        self._offered = command.due

    def compute_motion(self, tick: int) -> Motion:
        """Return the motion wanted at `tick`, with the acceleration half a tick later."""
        self._begin_next_curve(tick)
        offered = self._offered
        waiting = self._next
        if tick < offered != self._due and (waiting is None or offered != waiting.due):
            self._receive_set_point(offered, tick)
        if not self.holding and tick >= self._due:
            last = self._evaluate_motion(self._due)
            self.start(last.position, last.velocity, self._due)
        return self._evaluate_motion(tick)

    def ramp_to_rest(self, tick: int) -> Motion:
        """Return the motion wanted at `tick` while the arm ramps to rest by itself."""
        self._next = None
        if not self.holding or self.goal is not None:
            now = self._evaluate_motion(tick)
            self.start(now.position, now.velocity, tick)
        return self._evaluate_motion(tick)

    def move_to(self, goal: Array, tick: int) -> Motion:
        """Return the motion wanted at `tick` while the arm moves to a goal by itself.

        The motion ramps to rest, then goes straight to the goal within the limits of every joint.

        Args:
            goal: Position to reach at rest, (joints,), rad. It must be the same array object in
                every cycle.
            tick: Tick of the motion.
        """
        if self.goal is goal:
            return self._evaluate_motion(tick)
        now = self.ramp_to_rest(tick)
        if now.velocity.any():
            return now
        limits = self._limits
        fastest = self.speed_scale * limits.velocity
        hardest = self.speed_scale**2 * limits.acceleration
        self._curve = Passage(now.position, goal, fastest, hardest)
        self._from = tick
        self._difference = None
        self.goal = goal
        return self._evaluate_motion(tick)

    def _receive_set_point(self, due: int, tick: int) -> None:
        """Copy the set point accepted last, unless it is not finite or due too far ahead.

        It is followed once the previous set point is due, because some protocols deliver early.

        Args:
            due: Tick at which the set point is due.
            tick: Present tick.
        """
        command = self._command
        if command is None:
            return
        position = np.clip(command.position, *self._bounds.position.T)
        velocity = np.clip(command.velocity, -self._bounds.velocity, self._bounds.velocity)
        is_near = (due - tick) * self._tick_s <= MAX_AHEAD_S
        if is_near and np.isfinite((command.position, command.velocity)).all():
            self._next = SetPoint(due, position, velocity)
            is_cut = (position != command.position) | (velocity != command.velocity)
            self.refused += bool(is_cut.any())
        else:
            self.refused += 1
        self._begin_next_curve(tick)

    def _begin_next_curve(self, tick: int) -> None:
        """Begin the curve to the next set point once the previous one is due, or none is followed.

        Args:
            tick: Present tick.
        """
        if self._next is None or not (self.holding or tick >= self._due):
            return
        due, position, velocity = self._next
        self._next = None
        if due <= tick:
            return
        begin = tick if self.holding else self._due
        begin_s = (begin - self._from) * self._tick_s
        curve = Bridge(self._curve, begin_s, (position, velocity), (due - begin) * self._tick_s)
        if not self.holding and curve.is_within(MAX_ACCELERATION * self._limits.acceleration):
            self._curve = curve
            self._from = begin
            self._due = due
            if (
                self._difference is not None
                and (begin - self._differs_from) * self._tick_s >= self._difference.ends_s
            ):
                self._difference = None
            return
        now = self._evaluate_motion(tick)
        left_s = (due - tick) * self._tick_s
        self._curve = Curve(position - velocity * left_s, velocity * left_s, duration_s=left_s)
        self._from = tick
        self._due = due
        self.holding = False
        self._begin_decay(now.position, now.velocity, tick)

    def _begin_decay(self, position: Array, velocity: Array, tick: int) -> None:
        """Blend a motion into the curve: let their difference at `tick` decay smoothly.

        Args:
            position: Position of the motion at `tick`, (joints,), rad.
            velocity: Velocity of the motion at `tick`, (joints,), rad/s.
            tick: Tick at which the blend begins.
        """
        curve = self._curve.compute_motion((tick - self._from) * self._tick_s)
        fastest = JOINING_SPEED_PART * self.speed_scale * self._limits.velocity
        self._difference = Decay(
            position - curve.position, velocity - curve.velocity, fastest, self._limits.acceleration
        )
        self._differs_from = tick

    def _evaluate_motion(self, tick: int) -> Motion:
        """Evaluate the present curves at `tick`, and their acceleration half a tick later.

        The result is valid until the next call.
        """
        curve = self._curve
        difference = self._difference
        wanted = self._wanted
        time_s = (tick - self._from) * self._tick_s
        half_s = 0.5 * self._tick_s
        self._interpolate(curve.table, curve.duration_s, curve.ends_s, time_s, half_s, wanted.table)
        if difference is not None:
            time_s = (tick - self._differs_from) * self._tick_s
            lasts_s = difference.duration_s
            ends_s = difference.ends_s
            self._interpolate(difference.table, lasts_s, ends_s, time_s, half_s, self._motions[1])
            wanted.table += self._motions[1]
        return wanted
