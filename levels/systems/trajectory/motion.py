"""The commanded motion as samples: the leg under way, plus what is left of the motion before it.

In every cycle the motion is evaluated once, one sample ahead. Velocity and acceleration of a sample
are the differences of those around it, so they always fit the positions, however these come about.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rack.levels.algebra import Array
from rack.levels.primitive.path_motion import JointSetPoint
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.legs import BLEND_PART, Leg, Settling, Unfit

STOP_PART = 0.85
"""Part of the acceleration limits that a stop takes: states are known by differences of samples
only."""
LEAST_STOP_CYCLES = 5
"""A joint that hardly moves takes so long to stop, for its acceleration to end smoothly."""
EXCESS = 1.04
"""Multiple of a limit that a sample may show, as from rounding of inverse kinematics; the planned
velocity limits are 5 % below those of the arm."""
MAX_REST_RAD = 1e-7
"""Samples that differ by less are the same."""


class SampledMotion:
    """Begins legs, blends them, stops: without a step in position or velocity, within the limits of
    every joint.
    """

    def __init__(
        self, limits: Limits, joints: tuple[str, ...], period_s: float, rest: Array
    ) -> None:
        """Rest at the joint positions `rest`, (joints,), rad."""
        self._limits = limits
        self._joints = joints
        self._period_s = period_s
        # The leg under way or reached; None: the arm stops, or has stopped elsewhere.
        self.leg: Leg | None = None
        self._begun_s = 0.0
        self._settling: Settling | None = None
        self._settles_s = 0.0  # when that began
        self.rest_at(rest)

    def rest_at(self, position: Array) -> None:
        """Rest at joint positions (joints,), rad."""
        self.leg = None
        self._settling = None
        self._rest = np.array(position)
        self.time_s = 0.0  # of the present sample
        self._samples = self._rest, self._rest, self._rest  # those before, at and after it

    def advance(self, time_s: float) -> None:
        """Go on to the sample at `time_s`, the next one. Raises `Unfit` with the arm ramping to
        rest.
        """
        self.time_s = time_s
        _, velocity, acceleration = self.state
        before, here = self._samples[1:]
        self._samples = before, here, here
        try:
            self._look_ahead()
            if self.leg is not None:
                self._check()
        except Unfit:
            # The sample ahead cannot be made: go on from the state before this one.
            velocity = velocity + self._period_s * acceleration
            self._stop_from(JointSetPoint(here, velocity, acceleration))
            raise

    @property
    def state(self) -> JointSetPoint:
        """The present sample."""
        before, here, after = self._samples
        h = self._period_s
        return JointSetPoint(
            here, (after - before) / (2.0 * h), (after - 2.0 * here + before) / (h * h)
        )

    @property
    def leg_s(self) -> float:
        """Time since the leg began."""
        return self.time_s - self._begun_s

    @property
    def settled(self) -> bool:
        """Whether the leg, if there is one, has reached its goal, and nothing is left of the motion
        before it.
        """
        if self.leg is not None and self.leg_s < self.leg.law.ends_s:
            return False
        return self._settling is None or self.time_s - self._settles_s >= self._settling.ends_s

    @property
    def resting(self) -> bool:
        """Whether the present sample is at rest."""
        before, here, after = self._samples
        return bool(
            (np.abs(after - before) < MAX_REST_RAD).all()
            and (np.abs(after - here) < MAX_REST_RAD).all()
        )

    def stop(self) -> None:
        """Ramp to rest from the present sample."""
        self._stop_from(self.state)

    def _stop_from(self, state: JointSetPoint) -> None:
        self._settle(state, STOP_PART)
        self.leg = None
        self._look_ahead()

    def begin(self, make: Callable[[Array], Leg], half_blend_s: float) -> None:
        """Begin the leg that `make` makes from where the motion so far ends, which slows down over
        two half blends.

        Raises `Unfit` with the arm ramping to rest.
        """
        if self.settled and self.leg is not None and not self.leg.live:
            self._rest = self._samples[1]
            self._settling = None
        elif not self.settled or self.leg is not None:
            self._settle(self.state, BLEND_PART, 2.0 * half_blend_s)
        self.leg = None
        try:
            self.leg = make(self._rest)
            self._begun_s = self.time_s
        finally:
            self._look_ahead()

    def _settle(self, state: JointSetPoint, part: float, least_s: float = 0.0) -> None:
        least_s = max(least_s, LEAST_STOP_CYCLES * self._period_s)
        self._settling = Settling(state, part * self._limits.acceleration, least_s)
        self._settles_s = self.time_s
        self._rest = self._settling.end

    def _look_ahead(self) -> None:
        """Evaluate the sample ahead anew, the motion having changed."""
        before, here, _ = self._samples
        self._samples = before, here, self._evaluate(self.time_s + self._period_s)

    def _evaluate(self, time_s: float) -> Array:
        """Return the joint positions at `time_s`. Raises `Unfit`."""
        position = self._rest if self.leg is None else self.leg.at(time_s - self._begun_s)
        settling = self._settling
        if settling is None or time_s - self._settles_s >= settling.ends_s:
            return position
        return np.asarray(position + (settling.at(time_s - self._settles_s) - settling.end))

    def _check(self) -> None:
        """Raise `Unfit` if the present sample exceeds a limit, as when a live goal is too fast for
        the arm.
        """
        _, velocity, acceleration = self.state
        for values, limits, unit in (
            (velocity, self._limits.velocity, "rad/s"),
            (acceleration, self._limits.acceleration, "rad/s2"),
        ):
            # Written so that NaN is outside.
            if not (np.abs(values) <= EXCESS * limits).all():
                joint = int((np.abs(values) / limits).argmax())
                name = self._joints[joint]
                most = limits[joint]
                raise Unfit(
                    f"joint '{name}' would need {abs(values[joint]):.2f} {unit}; permitted:"
                    f" {most:.2f}"
                )
