"""Motion of the set point along one path.

The set point is always either at rest or on a trajectory. Motion can be held and resumed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.motion.path import COINCIDENT_RAD, BlendedPath
from rack.levels.motion.trajectory import Trajectory, make_stop
from rack.levels.robot.limits import Limits

NEAREST_STEP_RAD = 0.01
"""Spacing of the points among which the one nearest to the arm is chosen."""


class JointSetPoint(NamedTuple):
    """Set point of all joints at one time."""

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    acceleration: Array  # (joints,), rad/s2


class PathMotion:
    """Moves the set point along one path.

    If the arm begins slightly off the path, the motion removes this offset during its first
    `bridging_s`.

    Attributes:
        path: The path.
        s: Path parameter of the set point, rad.
        trajectory: Trajectory along the path, or None while the set point does not move.
        time_s: Time since the trajectory began.
        stopping: True if the trajectory is a ramp to rest.
        set_point: Set point computed by the last `advance_by`.
    """

    def __init__(self, path: BlendedPath, braking: Limits, bridging_s: float) -> None:
        self.path = path
        self.s = 0.0
        self.trajectory: Trajectory | None = None
        self.time_s = 0.0
        self.stopping = False
        self._braking = braking
        self._bridging_s = bridging_s
        self._bridged_s = bridging_s
        self._offset, self._scratch, *moving = np.zeros((4, path.joints))
        self.set_point = JointSetPoint(path.evaluate(0.0).q.copy(), *moving)

    @property
    def is_resting(self) -> bool:
        """True if the set point does not move."""
        return self.trajectory is None

    @property
    def is_finished(self) -> bool:
        """True if the set point is at rest at the end of the path."""
        return (
            self.is_resting and self.s >= self.path.length and self._bridged_s >= self._bridging_s
        )

    def reset_to(self, s: float, position: Array) -> float:
        """Reset the motion to rest at path parameter `s`, with the set point at the arm.

        Args:
            s: Path parameter in rad.
            position: Position of the arm, (joints,), rad.

        Returns:
            Largest distance of a joint from the path in rad. It is removed during the motion.
        """
        self.s = s
        self._clear_trajectory()
        np.subtract(position, self.path.evaluate(s).q, out=self._offset)
        distance = float(np.abs(self._offset).max())
        self._bridged_s = 0.0 if distance > COINCIDENT_RAD else self._bridging_s
        self.set_point.position[:] = position
        return distance

    def reset_to_nearest(self, position: Array, progress: float) -> float:
        """Reset the motion to rest at the point of the path that is nearest to the arm.

        If several points are equally near, because the path returns to an earlier position, take
        the one closest to `progress`. The set point is at the arm.

        Args:
            position: Position of the arm, (joints,), rad.
            progress: Approximate fraction of the path that is done, 0 to 1.

        Returns:
            Largest distance of a joint of the arm from that point, rad.
        """
        points = self.path.sample_points(NEAREST_STEP_RAD)
        distances = np.linalg.norm(points - position, axis=1)
        before = np.append(np.inf, distances[:-1])
        after = np.append(distances[1:], np.inf)
        minima = np.flatnonzero(
            (distances <= before)
            & (distances <= after)
            & (distances <= distances.min() + NEAREST_STEP_RAD)
        )
        # `linspace` returns the exact end. A value beyond it would permit no trajectory.
        places = np.linspace(0.0, self.path.length, len(points))[minima]
        nearest = np.argmin(np.abs(places - progress * self.path.length))
        return self.reset_to(float(places[nearest]), position)

    def follow_trajectory(self, trajectory: Trajectory) -> None:
        """Start to follow a trajectory. It must begin at rest at the present path parameter."""
        self.trajectory = trajectory
        self.time_s = 0.0
        self.stopping = False

    def begin_hold(self) -> None:
        """Begin a ramp to rest on the path as soon as the braking limits permit it.

        Call this in every cycle while motion must hold.
        """
        if self.trajectory is None or self.stopping:
            return
        stop = make_stop(self.path, self._braking, self.trajectory.evaluate_at(self.time_s))
        if stop is not None:
            self.trajectory = stop
            self.time_s = 0.0
            self.stopping = True

    def advance_by(self, duration_s: float) -> None:
        """Advance the set point by `duration_s`."""
        position, velocity, acceleration = self.set_point
        if self.trajectory is None:
            velocity.fill(0.0)
            acceleration.fill(0.0)
            return
        self.time_s += duration_s
        self.s, ds, dds = self.trajectory.evaluate_at(self.time_s)
        q, dq_ds, d2q_ds2 = self.path.evaluate(self.s)
        position[:] = q
        np.multiply(dq_ds, ds, out=velocity)
        np.multiply(d2q_ds2, ds * ds, out=acceleration)
        acceleration += np.multiply(dq_ds, dds, out=self._scratch)
        if self._bridged_s < self._bridging_s:
            # Add the remaining offset. Its factor is a quintic from 1 to 0, at rest at both ends.
            self._bridged_s = min(self._bridged_s + duration_s, self._bridging_s)
            u = self._bridged_s / self._bridging_s
            per_s = 1.0 / self._bridging_s
            remaining_part = 1.0 - u**3 * (10.0 + u * (6.0 * u - 15.0))
            rate = -30.0 * u**2 * (1.0 - u) ** 2 * per_s
            change = -60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) * per_s**2
            for value, factor in zip(self.set_point, (remaining_part, rate, change), strict=True):
                value += np.multiply(self._offset, factor, out=self._scratch)
        # The trajectory does not end while an offset from the path remains to be removed.
        if self.time_s >= self.trajectory.duration and self._bridged_s >= self._bridging_s:
            # Trajectories end with rounding errors, so set the exact end of the path.
            if not self.stopping or self.s > self.path.length - COINCIDENT_RAD:
                self.s = self.path.length
                position[:] = self.path.evaluate(self.s).q
            self._clear_trajectory()

    def _clear_trajectory(self) -> None:
        """Drop the trajectory, and set velocity and acceleration to zero."""
        self.trajectory = None
        self.stopping = False
        self.set_point.velocity.fill(0.0)
        self.set_point.acceleration.fill(0.0)
