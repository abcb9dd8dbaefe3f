"""Legs: motions from rest to rest, straight in joint space or of the tool, as functions of time.

A leg of segment time T and half blend time a lasts T + 2a: its speed rises over 2a, stays, and
falls over 2a. Its bends take at most half the acceleration of every joint, so a leg that begins
while the one before it slows down keeps the limits. This is the straight path with polynomial
transitions of RCCL [recalled]: two legs in sequence, the second begun a before the first ends, are
one motion with matched position, velocity and acceleration.

The goal of a tool path is fixed, or in the frame of a body of the world model that it follows.
A live goal is RCCL's functional transform: its function runs once for every sample, and an age
stamp keeps a second reader of the same sample from running it again [S7]. The frame is extrapolated
from when the body was sensed to the sample's time, and smoothed: a body may start with a jolt, an
arm cannot. The smoothed frame catches up with a body of constant velocity completely.
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
from rack.levels.planning.pose import Pose, pose
from rack.levels.robot.limits import Limits
from rack.levels.systems.trajectory.messages import MotionRequest

BLEND_PART = 0.5
"""Part of the acceleration limits that one leg takes: two blended ones take all."""
PEAK = 0.75
"""Greatest acceleration of a change of speed by 1 over 2a, times a."""
STEP_M = 0.04
STEP_RAD = 0.1
"""Distance and turn between the poses of a tool path that are tried before it begins."""
MAX_STEPS = 40
SAMPLED = 1.15
"""Factor on speeds and bends of a tool path that were found at its tried poses: between them they
may be greater."""


class Unfit(Exception):
    """A motion that the arm cannot make; its text says why."""


class WorldSight:
    """The world model as of this cycle, extrapolated."""

    def __init__(self, bodies: tuple[str, ...], blind_s: float, tick_s: float) -> None:
        """See `bodies`, in the model's order; extrapolate for `blind_s` at most."""
        self._bodies = bodies
        self._blind_s = blind_s
        self._tick_s = tick_s
        self._model: WorldState | None = None

    def look(self, world: Reading[WorldState]) -> None:
        """Take over the newest model."""
        if world.is_there and world.message.revision:
            self._model = world.message

    @property
    def knows(self) -> bool:
        """Whether anything has been sensed."""
        return self._model is not None

    def misfit(self, row: int) -> str:
        """Return why the world model has no such body; empty: it has."""
        if -1 <= row < len(self._bodies):
            return ""
        return (
            f"body {row} is not in the world model; permitted: -1 (world) to"
            f" {len(self._bodies) - 1}"
        )

    def frame(self, row: int, time_s: float) -> tuple[Pose, Array]:
        """Return where body `row` should be at `time_s`, and its velocity (3,), m/s; zero for one
        not seen lately.
        """
        model = self._model
        if model is None:
            raise Unfit("nothing is known of the world")
        ahead_s = time_s - model.sensed * self._tick_s
        velocity = np.array(model.velocity[row]) if ahead_s <= self._blind_s else np.zeros(3)
        place = model.position[row] + model.velocity[row] * min(ahead_s, self._blind_s)
        return pose(place, model.quaternion[row]), velocity


class ToolGoal:
    """The goal of one request."""

    def __init__(self, request: MotionRequest, sight: WorldSight, follow_s: float) -> None:
        """Follow a live goal with the time constant `follow_s`."""
        self._goal = pose(request.position, request.quaternion)  # in the frame of the body
        self._body = request.body  # row in the world model; -1: the world
        self.live = request.live and request.body >= 0
        self._sight = sight
        self._follow_s = follow_s
        self._stamp_s = -1.0  # of the sample for which `pose` was evaluated
        self._frame: Pose | None = None
        self._velocity = np.zeros(3)
        self._turning = np.zeros(3)
        self.pose = self._goal  # of the tool, for that sample

    def update(self, time_s: float) -> None:
        """Evaluate the goal for the sample at `time_s`; again for the same one does nothing. Raises
        `Unfit`.
        """
        if self._body < 0 or time_s == self._stamp_s or (self._frame is not None and not self.live):
            return
        seen, velocity = self._sight.frame(self._body, time_s)
        if self._frame is None:
            self._frame = seen
            self._velocity = velocity
        else:
            self._frame = self._followed(self._frame, seen, velocity, time_s - self._stamp_s)
        self._stamp_s = time_s
        self.pose = self._frame @ self._goal

    def astray(self, position: Array, time_s: float) -> float:
        """Return the distance, m, of a tool position at `time_s` from the goal on the body,
        unsmoothed.
        """
        return norm((self._sight.frame(self._body, time_s)[0] @ self._goal).position - position)

    def _followed(self, frame: Pose, seen: Pose, velocity: Array, passed_s: float) -> Pose:
        """Return the frame that goes after the body, critically damped; its turning is followed
        with a lag.
        """
        pace = 1.0 / self._follow_s
        turn = np.zeros(3)
        quaternion = frame.quaternion.copy()
        mujoco.mju_subQuat(turn, seen.quaternion, quaternion)
        # The body moves at its velocity in the step that ends at `seen`.
        off = seen.position - velocity * passed_s - frame.position
        self._velocity = self._velocity + passed_s * pace * (
            pace * off + 2.0 * (velocity - self._velocity)
        )
        self._turning = self._turning + passed_s * pace * (pace * turn - 2.0 * self._turning)
        mujoco.mju_quatIntegrate(quaternion, self._turning, passed_s)
        return pose(frame.position + passed_s * self._velocity, quaternion)


class Times(NamedTuple):
    """Times that a request wants, s."""

    segment: float  # 0: from the limits
    half_blend: float


class TimeLaw:
    """The part of the way done, 0 to 1, by the time since the begin."""

    def __init__(self, segment_s: float, half_blend_s: float, least_s: float = 0.0) -> None:
        self.segment_s = segment_s
        self.half_blend_s = half_blend_s
        self.least_s = least_s  # least half blend time in which it may slow down
        # Half the time in which the speed falls at the end: at most the leg's own half blend time,
        # and more than none.
        self.leaving_s = half_blend_s

    @property
    def nominal_s(self) -> float:
        """Time at which the goal would be reached at full speed: the middle of a blend into another
        leg.
        """
        return self.half_blend_s + self.segment_s

    @property
    def ends_s(self) -> float:
        """Time at which the leg rests at its goal."""
        return self.nominal_s + self.leaving_s

    def part(self, time_s: float) -> float:
        """Return the part done after `time_s`."""
        if time_s <= 0.0:
            return 0.0
        left = self.ends_s - time_s
        if left <= 0.0:
            return 1.0
        if left < 2.0 * self.leaving_s:
            return 1.0 - _ramp(left, self.leaving_s) / self.segment_s
        half_s = self.half_blend_s
        way = _ramp(time_s, half_s) if time_s < 2.0 * half_s else time_s - half_s
        return way / self.segment_s


def _ramp(time_s: float, half_s: float) -> float:
    """Return the way after `time_s` of a smooth rise of speed from 0 to 1 over 2 `half_s`."""
    h = time_s / (2.0 * half_s)
    return 2.0 * half_s * h * h * h * (1.0 - 0.5 * h)


class JointLeg:
    """A straight line in joint space."""

    live = False  # the goal does not move

    def __init__(self, start: Array, goal: Array, times: Times, limits: Limits) -> None:
        self._start = start.copy()
        self._way = goal - start
        self.law = timed(times, np.abs(self._way), np.zeros(len(goal)), limits)

    def at(self, time_s: float) -> Array:
        """Return joint positions (joints,), rad, `time_s` after the begin."""
        return np.asarray(self._start + self.law.part(time_s) * self._way)


class ToolLeg:
    """A straight line of the tool that turns at a constant rate, to a goal that may move.

    Inverse kinematics stays on the branch of the start.
    """

    def __init__(
        self,
        start: Array,
        goal: ToolGoal,
        times: Times,
        ik: InverseKinematics,
        limits: Limits,
    ) -> None:
        """Prepare the way from the joint positions `start`. Raises `Unfit`."""
        self._ik = ik
        self._from = ik.tool_at(start)
        self._goal = goal
        self.live = goal.live
        self._last = start.copy()
        speed, bend = self._try_out(start, goal.pose)
        self.law = timed(times, speed, bend, limits)

    def at(self, time_s: float) -> Array:
        """Return joint positions (joints,), rad, `time_s` after the begin. Raises `Unfit`."""
        part = self.law.part(time_s)
        self._last = self._solve(self._from.towards(self._goal.pose, part), self._last, part)
        return self._last

    def _solve(self, pose: Pose, near: Array, part: float) -> Array:
        found = self._ik.nearby(pose, near)
        if found is None:
            x, y, z = pose.position
            raise Unfit(
                f"no joint positions for the tool at {x:.3f} {y:.3f} {z:.3f}, {part:.0%} of the way"
            )
        return found

    def _try_out(self, start: Array, goal: Pose) -> tuple[Array, Array]:
        """Return the greatest first and second derivative of the joints by the part of the way,
        (joints,) each.
        """
        way = norm(goal.position - self._from.position)
        turn = self._from.angle_to(goal)
        steps = min(max(ceil(way / STEP_M), ceil(turn / STEP_RAD), 4), MAX_STEPS)
        points = [start]
        for k in range(1, steps + 1):
            points.append(self._solve(self._from.towards(goal, k / steps), points[-1], k / steps))
        first = np.diff(points, axis=0) * steps
        second = np.diff(first, axis=0) * steps
        return SAMPLED * np.abs(first).max(axis=0), SAMPLED * np.abs(second).max(axis=0)


Leg = JointLeg | ToolLeg
"""One motion."""


def timed(times: Times, speed: Array, bend: Array, limits: Limits) -> TimeLaw:
    """Return the time law of a leg.

    `speed` and `bend` are the first and second derivatives of joint positions by the part of the
    way, (joints,) each. A segment time that is too short for a limit, or for two blends, is
    stretched.
    """
    half = times.half_blend
    most = BLEND_PART * limits.acceleration
    slope = PEAK * speed / half
    needed = np.maximum(
        speed / limits.velocity, (slope + np.sqrt(slope * slope + 4.0 * most * bend)) / (2.0 * most)
    )
    segment = max(float(needed.max()), times.segment, 2.0 * half)
    room = most - bend / (segment * segment)
    return TimeLaw(segment, half, min(half, float((PEAK * speed / segment / room).max())))


class Settling:
    """A ramp to rest of every joint by itself: matched position, velocity and acceleration, then
    rest.
    """

    def __init__(self, state: tuple[Array, Array, Array], most: Array, least_s: float) -> None:
        """Begin at `state`, rad, rad/s, rad/s2, within the accelerations `most`, in `least_s` or
        more.
        """
        self._position, self._velocity, acceleration = state
        # The peak is at most 1.5 |v| / T + |a| / 3, and |a| at the begin.
        self._acceleration = np.clip(acceleration, -most, most)
        room = most - np.abs(self._acceleration) / 3.0
        self._time_s = np.maximum(1.5 * np.abs(self._velocity) / room, least_s)
        self.ends_s = float(self._time_s.max())
        self.end = self.at(self.ends_s)  # (joints,), rad: where the joints come to rest

    def at(self, time_s: float) -> Array:
        """Return joint positions (joints,), rad, `time_s` after the begin."""
        t = self._time_s
        h = np.minimum(time_s / t, 1.0)
        by_velocity = h - h * h * h * (1.0 - 0.5 * h)
        by_acceleration = h * h * (0.5 - h * (2.0 / 3.0 - 0.25 * h))
        return np.asarray(
            self._position
            + t * (self._velocity * by_velocity + self._acceleration * t * by_acceleration)
        )
