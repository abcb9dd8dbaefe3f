"""The commanded motion as samples: the leg under way, plus the remainder of the previous motion.

The motion is evaluated once per cycle, one sample ahead. Velocity and acceleration of a sample are
finite differences of the neighbouring samples, and are therefore always consistent with the
positions.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rack.levels.algebra import Array
from rack.levels.primitive.path_motion import JointSetPoint
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.legs import (
    LEG_ACCELERATION_FRACTION,
    InfeasibleMotion,
    Leg,
    RampToRest,
)

STOP_ACCELERATION_FRACTION = 0.85
"""Fraction of the acceleration limits that a stop uses.

The margin is needed because states are known only as differences of samples.
"""
MIN_STOP_CYCLES = 5
"""Shortest stop, which lets the acceleration of a slow joint end smoothly."""
LIMIT_TOLERANCE_FACTOR = 1.04
"""Multiple of a limit that a sample may reach, for example by rounding of inverse kinematics.

The planned velocity limits are 5 % lower than the limits of the arm.
"""
MAX_REST_RAD = 1e-7
"""Samples that differ by less than this are equal."""


class SampledMotion:
    """Begins, blends and stops legs, which are motions from rest to rest.

    Position and velocity are continuous, and every joint stays within its limits.

    Attributes:
        leg: Current or completed leg. None if the arm is stopping, or has stopped without reaching
            a goal.
        time_s: Time of the current sample, s.
    """

    def __init__(
        self, limits: Limits, joints: tuple[str, ...], period_s: float, rest: Array
    ) -> None:
        """Start at rest.

        Args:
            limits: Velocity and acceleration limits of the joints.
            joints: Names of the joints.
            period_s: Time between samples, s.
            rest: Joint positions at which the arm rests, (joints,), rad.
        """
        self._limits = limits
        self._joints = joints
        self._period_s = period_s
        self.leg: Leg | None = None
        self._leg_start_s = 0.0
        self._ramp: RampToRest | None = None
        self._ramp_start_s = 0.0  # time at which the ramp began
        self.rest_at(rest)

    def rest_at(self, position: Array) -> None:
        """Drop the leg and rest at `position`, (joints,), in rad. The sample time restarts at 0."""
        self.leg = None
        self._ramp = None
        self._rest = np.array(position)
        self.time_s = 0.0
        # The samples before, at and after `time_s`.
        self._samples = self._rest, self._rest, self._rest

    def advance_to(self, time_s: float) -> None:
        """Advance to the next sample, at `time_s`.

        Raises:
            InfeasibleMotion: If the motion cannot continue. The arm is then ramping to rest.
        """
        self.time_s = time_s
        _, velocity, acceleration = self.state
        before, present = self._samples[1:]
        self._samples = before, present, present
        try:
            self._evaluate_next_sample()
            if self.leg is not None:
                self._check_limits()
        except InfeasibleMotion:
            # The next sample cannot be computed: ramp to rest from the previous state.
            velocity = velocity + self._period_s * acceleration
            self._ramp_to_rest_from(JointSetPoint(present, velocity, acceleration))
            raise

    @property
    def state(self) -> JointSetPoint:
        """Position, velocity and acceleration of the current sample."""
        before, present, after = self._samples
        h = self._period_s
        return JointSetPoint(
            present, (after - before) / (2.0 * h), (after - 2.0 * present + before) / (h * h)
        )

    @property
    def leg_s(self) -> float:
        """Time, in s, since the leg began."""
        return self.time_s - self._leg_start_s

    @property
    def is_settled(self) -> bool:
        """Whether the leg has reached its goal and the previous motion has decayed completely."""
        if self.leg is not None and self.leg_s < self.leg.law.ends_s:
            return False
        return self._ramp is None or self.time_s - self._ramp_start_s >= self._ramp.ends_s

    @property
    def is_resting(self) -> bool:
        """Whether the current sample is at rest."""
        before, present, after = self._samples
        return bool(
            (np.abs(after - before) < MAX_REST_RAD).all()
            and (np.abs(after - present) < MAX_REST_RAD).all()
        )

    def ramp_to_rest(self) -> None:
        """Ramp to rest from the current sample."""
        self._ramp_to_rest_from(self.state)

    def _ramp_to_rest_from(self, state: JointSetPoint) -> None:
        """Drop the leg and ramp to rest from the sample `state`."""
        self._start_ramp_to_rest(state, STOP_ACCELERATION_FRACTION)
        self.leg = None
        self._evaluate_next_sample()

    def begin_leg(self, make: Callable[[Array], Leg], half_blend_s: float) -> None:
        """Begin a leg while the previous motion slows down.

        Args:
            make: Builds the leg from the joint positions at which the previous motion will end.
            half_blend_s: Half the time in which the previous motion slows down, s.

        Raises:
            InfeasibleMotion: If `make` raises it. The arm is then ramping to rest.
        """
        if self.is_settled and self.leg is not None and not self.leg.live:
            self._rest = self._samples[1]
            self._ramp = None
        elif not self.is_settled or self.leg is not None:
            self._start_ramp_to_rest(self.state, LEG_ACCELERATION_FRACTION, 2.0 * half_blend_s)
        self.leg = None
        try:
            self.leg = make(self._rest)
            self._leg_start_s = self.time_s
        finally:
            self._evaluate_next_sample()

    def _start_ramp_to_rest(
        self, state: JointSetPoint, fraction: float, least_s: float = 0.0
    ) -> None:
        """Start a ramp from the current motion to rest.

        Args:
            state: Sample from which the ramp starts.
            fraction: Fraction of the acceleration limits to use.
            least_s: Shortest time of the ramp, s.
        """
        least_s = max(least_s, MIN_STOP_CYCLES * self._period_s)
        self._ramp = RampToRest(state, fraction * self._limits.acceleration, least_s)
        self._ramp_start_s = self.time_s
        self._rest = self._ramp.end

    def _evaluate_next_sample(self) -> None:
        """Compute the next sample. This must be called again whenever the motion changes."""
        before, present, _ = self._samples
        self._samples = before, present, self._compute_position(self.time_s + self._period_s)

    def _compute_position(self, time_s: float) -> Array:
        """Return the joint positions at `time_s`.

        They are the sum of the leg and the remainder of the previous motion, which decays.

        Raises:
            InfeasibleMotion: If the leg has no joint positions at that time.
        """
        position = (
            self._rest
            if self.leg is None
            else self.leg.compute_position(time_s - self._leg_start_s)
        )
        settling = self._ramp
        if settling is None or time_s - self._ramp_start_s >= settling.ends_s:
            return position
        return np.asarray(
            position + (settling.compute_position(time_s - self._ramp_start_s) - settling.end)
        )

    def _check_limits(self) -> None:
        """Raise `InfeasibleMotion` if the current sample exceeds a limit.

        This happens, for example, when a live goal is too fast for the arm.
        """
        _, velocity, acceleration = self.state
        for values, limits, unit in (
            (velocity, self._limits.velocity, "rad/s"),
            (acceleration, self._limits.acceleration, "rad/s2"),
        ):
            # The comparison is written such that NaN exceeds the limit.
            if not (np.abs(values) <= LIMIT_TOLERANCE_FACTOR * limits).all():
                joint = int((np.abs(values) / limits).argmax())
                name = self._joints[joint]
                limit = limits[joint]
                raise InfeasibleMotion(
                    f"joint '{name}' would need {abs(values[joint]):.2f} {unit}; permitted:"
                    f" {limit:.2f}"
                )
