"""Legs: motions from rest to rest, straight in joint space or for the tool, as functions of time.

A leg with segment time T and half blend time a lasts T + 2a: its speed rises during 2a, remains
constant, and falls during 2a. A leg uses at most half of each joint's acceleration limit, which
keeps the limits when a leg begins while the previous one slows down. This is RCCL's straight path
with polynomial transitions [recalled]: two overlapping legs are one motion with continuous
position, velocity and acceleration.

The goal of a tool path is fixed, or follows a body of the world model. A live goal is RCCL's
functional transform: its function runs once per sample, and an age stamp prevents a second
evaluation for the same sample [S7]. The frame is extrapolated from the time at which the body was
sensed to the time of the sample. It is also smoothed, because a body may start with a jolt and an
arm cannot. For a body of constant velocity the smoothed frame has no lag in the end.
"""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.level import Reading
from rack.levels.messages import WorldState
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, make_pose
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.messages import MotionRequest

LEG_ACCELERATION_FRACTION = 0.5
"""Fraction of the acceleration limits that one leg uses. Two blended legs use all of them."""
PEAK_ACCELERATION_FACTOR = 0.75
"""Peak acceleration of a change of speed by 1 during 2a, times a."""
STEP_M = 0.04
"""Largest distance between poses of a tool path that are tested before it begins, m."""
STEP_RAD = 0.1
"""Largest turn between such poses, rad."""
MAX_PATH_STEPS = 40
"""Largest number of poses of a tool path that are tested."""
SAMPLING_MARGIN = 1.15
"""Safety factor on the derivatives found at the tested poses of a tool path.

Between these poses they may be greater.
"""


class InfeasibleMotion(Exception):
    """Raised for a motion that the arm cannot make. The text gives the reason."""


class WorldView:
    """The world model as known in this cycle, with extrapolated bodies."""

    def __init__(self, bodies: tuple[str, ...], blind_s: float, tick_s: float) -> None:
        """Start without a model.

        Args:
            bodies: Names of the bodies, in the order of the world model.
            blind_s: Longest time for which the motion of a body is extrapolated, s.
            tick_s: Period of the system clock, s.
        """
        self._bodies = bodies
        self._blind_s = blind_s
        self._tick_s = tick_s
        self._model: WorldState | None = None

    def update_model(self, world: Reading[WorldState]) -> None:
        """Store the newest world model, if it has been sensed."""
        if world.has_message and world.message.revision:
            self._model = world.message

    @property
    def has_model(self) -> bool:
        """Whether a world model has been received."""
        return self._model is not None

    def find_body_error(self, row: int) -> str:
        """Return why the number of a body is invalid, or an empty string if it is valid.

        Args:
            row: Row of the body in the world model. -1 for the world.
        """
        if -1 <= row < len(self._bodies):
            return ""
        return (
            f"body {row} is not in the world model; permitted: -1 (world) to"
            f" {len(self._bodies) - 1}"
        )

    def predict_frame(self, row: int, time_s: float) -> tuple[Pose, Array]:
        """Predict the frame and the velocity of a body.

        Args:
            row: Row of the body in the world model.
            time_s: Simulated time of the prediction, s.

        Returns:
            The pose, and the velocity, (3,), m/s. The velocity is zero if the body was last
            sensed more than `blind_s` ago.

        Raises:
            InfeasibleMotion: If no world model has been received.
        """
        model = self._model
        if model is None:
            raise InfeasibleMotion("nothing is known of the world")
        ahead_s = time_s - model.sensed * self._tick_s
        velocity = np.array(model.velocity[row]) if ahead_s <= self._blind_s else np.zeros(3)
        position = model.position[row] + model.velocity[row] * min(ahead_s, self._blind_s)
        return make_pose(position, model.quaternion[row]), velocity


class ToolGoal:
    """Goal of one tool motion, fixed or live.

    Attributes:
        pose: Goal of the tool in the world, for the sample that was evaluated last.
        live: Whether the goal follows a body.
    """

    def __init__(self, request: MotionRequest, sight: WorldView, follow_s: float) -> None:
        """Start at the pose of the request.

        Args:
            request: Request of kind POSE.
            sight: Gives the frame of the body.
            follow_s: Time constant with which a live goal follows its body, s.
        """
        self._goal = make_pose(request.position, request.quaternion)  # in the frame of the body
        self._body = request.body  # row in the world model, -1 for the world
        self.live = request.live and request.body >= 0
        self._sight = sight
        self._follow_s = follow_s
        self._stamp_s = -1.0  # time of the sample for which `pose` was evaluated
        self._frame: Pose | None = None
        self._velocity = np.zeros(3)
        self._turning = np.zeros(3)
        self.pose = self._goal

    def update_pose(self, time_s: float) -> None:
        """Update `pose` for the sample at `time_s`.

        A second call for the same sample has no effect.

        Raises:
            InfeasibleMotion: If no world model has been received.
        """
        if self._body < 0 or time_s == self._stamp_s or (self._frame is not None and not self.live):
            return
        body_frame, velocity = self._sight.predict_frame(self._body, time_s)
        if self._frame is None:
            self._frame = body_frame
            self._velocity = velocity
        else:
            self._frame = self._smooth_frame(
                self._frame, body_frame, velocity, time_s - self._stamp_s
            )
        self._stamp_s = time_s
        self.pose = self._frame @ self._goal

    def compute_deviation(self, position: Array, time_s: float) -> float:
        """Return the distance, in m, of a tool position from the unsmoothed goal at `time_s`."""
        return norm(
            (self._sight.predict_frame(self._body, time_s)[0] @ self._goal).position - position
        )

    def _smooth_frame(self, frame: Pose, body_frame: Pose, velocity: Array, step_s: float) -> Pose:
        """Return the frame after one step of following the body.

        The position is critically damped and follows a constant velocity without lag. The
        orientation is followed with a lag.

        Args:
            frame: Smoothed frame of the previous sample.
            body_frame: Predicted frame of the body.
            velocity: Velocity of the body, (3,), m/s.
            step_s: Time since the previous sample, s.
        """
        rate = 1.0 / self._follow_s
        rotation_error = np.zeros(3)
        quaternion = frame.quaternion.copy()
        mujoco.mju_subQuat(rotation_error, body_frame.quaternion, quaternion)
        # The body moves at its velocity during the step that ends at `body_frame`.
        position_error = body_frame.position - velocity * step_s - frame.position
        self._velocity = self._velocity + step_s * rate * (
            rate * position_error + 2.0 * (velocity - self._velocity)
        )
        self._turning = self._turning + step_s * rate * (
            rate * rotation_error - 2.0 * self._turning
        )
        mujoco.mju_quatIntegrate(quaternion, self._turning, step_s)
        return make_pose(frame.position + step_s * self._velocity, quaternion)


class LegTimes(NamedTuple):
    """Times that a request asks for, in s."""

    segment: float  # 0 to choose it from the limits
    half_blend: float


class TimeLaw:
    """Progress along a leg, 0 to 1, as a function of the time since its start.

    Attributes:
        segment_s: Time of the segment, s.
        half_blend_s: Half the time in which the speed rises at the start, s.
        min_end_blend_half_s: Shortest permitted value of `end_blend_half_s`, s.
        end_blend_half_s: Half the time in which the speed falls at the end, s. It is positive, and
            at most `half_blend_s`.
    """

    def __init__(
        self, segment_s: float, half_blend_s: float, min_end_blend_half_s: float = 0.0
    ) -> None:
        self.segment_s = segment_s
        self.half_blend_s = half_blend_s
        self.min_end_blend_half_s = min_end_blend_half_s
        self.end_blend_half_s = half_blend_s

    @property
    def nominal_s(self) -> float:
        """Time, in s, at which the goal would be reached without slowing down.

        A blend into another leg is centred on this time.
        """
        return self.half_blend_s + self.segment_s

    @property
    def ends_s(self) -> float:
        """Time, in s, at which the leg comes to rest at its goal."""
        return self.nominal_s + self.end_blend_half_s

    def compute_progress(self, time_s: float) -> float:
        """Return the progress after `time_s`, 0 to 1."""
        if time_s <= 0.0:
            return 0.0
        remaining_s = self.ends_s - time_s
        if remaining_s <= 0.0:
            return 1.0
        if remaining_s < 2.0 * self.end_blend_half_s:
            return 1.0 - _compute_ramp_distance(remaining_s, self.end_blend_half_s) / self.segment_s
        half_s = self.half_blend_s
        distance = (
            _compute_ramp_distance(time_s, half_s) if time_s < 2.0 * half_s else time_s - half_s
        )
        return distance / self.segment_s


def _compute_ramp_distance(time_s: float, half_s: float) -> float:
    """Return the distance covered `time_s` after the start of a smooth rise of speed.

    The speed rises from 0 to 1 within 2 * `half_s`.
    """
    h = time_s / (2.0 * half_s)
    return 2.0 * half_s * h * h * h * (1.0 - 0.5 * h)


class JointLeg:
    """A straight line in joint space."""

    live = False  # the goal does not move

    def __init__(self, start: Array, goal: Array, times: LegTimes, limits: Limits) -> None:
        self._start = start.copy()
        self._displacement = goal - start
        self.law = build_time_law(times, np.abs(self._displacement), np.zeros(len(goal)), limits)

    def compute_position(self, time_s: float) -> Array:
        """Return the joint positions, (joints,), in rad, at `time_s` after the start."""
        return np.asarray(self._start + self.law.compute_progress(time_s) * self._displacement)


class ToolLeg:
    """A straight line of the tool with a constant rate of turn, to a goal that may move.

    Inverse kinematics stays on the branch of the first joint positions.
    """

    def __init__(
        self,
        start: Array,
        goal: ToolGoal,
        times: LegTimes,
        ik: InverseKinematics,
        limits: Limits,
    ) -> None:
        """Solve the path at some poses and choose its time law.

        Args:
            start: Joint positions at the start, (joints,), rad.
            goal: Goal of the tool.
            times: Times that the request asks for.
            ik: Inverse kinematics of the arm.
            limits: Velocity and acceleration limits of the joints.

        Raises:
            InfeasibleMotion: If a pose of the path has no joint positions.
        """
        self._ik = ik
        self._from = ik.compute_tool_pose(start)
        self._goal = goal
        self.live = goal.live
        self._last = start.copy()
        speed, bend = self._sample_derivatives(start, goal.pose)
        self.law = build_time_law(times, speed, bend, limits)

    def compute_position(self, time_s: float) -> Array:
        """Return the joint positions, (joints,), in rad, at `time_s` after the start.

        Raises:
            InfeasibleMotion: If the pose has no joint positions.
        """
        progress = self.law.compute_progress(time_s)
        self._last = self._solve_joints(
            self._from.interpolate_to(self._goal.pose, progress), self._last, progress
        )
        return self._last

    def _solve_joints(self, pose: Pose, start: Array, share: float) -> Array:
        """Return joint positions for a pose of the tool on the branch of `start`.

        Raises `InfeasibleMotion` if there are none. Its text contains `share`, the completed
        fraction of the path.
        """
        joints = self._ik.find_nearby(pose, start)
        if joints is None:
            x, y, z = pose.position
            raise InfeasibleMotion(
                f"no joint positions for the tool at {x:.3f} {y:.3f} {z:.3f},"
                f" {share:.0%} of the way"
            )
        return joints

    def _sample_derivatives(self, start: Array, goal: Pose) -> tuple[Array, Array]:
        """Return the largest first and second derivatives of the joints along the path.

        Both have shape (joints,). The derivatives are with respect to the progress. They are
        estimated from sampled poses and increased by `SAMPLING_MARGIN`.
        """
        distance = norm(goal.position - self._from.position)
        turn = self._from.compute_angle(goal)
        steps = min(max(ceil(distance / STEP_M), ceil(turn / STEP_RAD), 4), MAX_PATH_STEPS)
        points = [start]
        for k in range(1, steps + 1):
            points.append(
                self._solve_joints(
                    self._from.interpolate_to(goal, k / steps), points[-1], k / steps
                )
            )
        first = np.diff(points, axis=0) * steps
        second = np.diff(first, axis=0) * steps
        return SAMPLING_MARGIN * np.abs(first).max(axis=0), SAMPLING_MARGIN * np.abs(second).max(
            axis=0
        )


Leg = JointLeg | ToolLeg
"""A single motion."""


def build_time_law(times: LegTimes, speed: Array, curvature: Array, limits: Limits) -> TimeLaw:
    """Build the time law of a leg.

    A segment time that is too short for a limit, or for two blends, is lengthened.

    Args:
        times: Times that the request asks for.
        speed: Largest first derivative of the joint positions with respect to the progress,
            (joints,), rad.
        curvature: Largest second derivative, (joints,), rad.
        limits: Velocity and acceleration limits of the joints.
    """
    half_blend_s = times.half_blend
    max_acceleration = LEG_ACCELERATION_FRACTION * limits.acceleration
    slope = PEAK_ACCELERATION_FACTOR * speed / half_blend_s
    needed_s = np.maximum(
        speed / limits.velocity,
        (slope + np.sqrt(slope * slope + 4.0 * max_acceleration * curvature))
        / (2.0 * max_acceleration),
    )
    segment_s = max(float(needed_s.max()), times.segment, 2.0 * half_blend_s)
    spare_acceleration = max_acceleration - curvature / (segment_s * segment_s)
    end_half_s = float((PEAK_ACCELERATION_FACTOR * speed / segment_s / spare_acceleration).max())
    return TimeLaw(segment_s, half_blend_s, min(half_blend_s, end_half_s))


class RampToRest:
    """A ramp of every joint to rest, independent of the other joints.

    It starts with the given position, velocity and acceleration.

    Attributes:
        ends_s: Time at which the last joint rests, s.
        end: Joint positions at rest, (joints,), rad.
    """

    def __init__(
        self, state: tuple[Array, Array, Array], max_acceleration: Array, min_duration_s: float
    ) -> None:
        """Compute the ramp of each joint.

        Args:
            state: Positions, velocities and accelerations at the start, rad, rad/s, rad/s2.
            max_acceleration: Acceleration limits of the joints, (joints,), rad/s2.
            min_duration_s: Shortest time of a ramp, s.
        """
        self._position, self._velocity, acceleration = state
        # The peak acceleration is at most 1.5 |v| / T + |a| / 3 later, and |a| at the start.
        self._acceleration = np.clip(acceleration, -max_acceleration, max_acceleration)
        spare_acceleration = max_acceleration - np.abs(self._acceleration) / 3.0
        self._time_s = np.maximum(1.5 * np.abs(self._velocity) / spare_acceleration, min_duration_s)
        self.ends_s = float(self._time_s.max())
        self.end = self.compute_position(self.ends_s)

    def compute_position(self, time_s: float) -> Array:
        """Return the joint positions, (joints,), in rad, at `time_s` after the start."""
        t = self._time_s
        h = np.minimum(time_s / t, 1.0)
        by_velocity = h - h * h * h * (1.0 - 0.5 * h)
        by_acceleration = h * h * (0.5 - h * (2.0 / 3.0 - 0.25 * h))
        return np.asarray(
            self._position
            + t * (self._velocity * by_velocity + self._acceleration * t * by_acceleration)
        )
