"""The goal of a tool path: fixed, or in the frame of a body of the world model that it follows.

A live goal is RCCL's functional transform: its function runs once for every sample, and an age
stamp keeps a second reader of the same sample from running it again [S7]. The frame is extrapolated
from when the body was sensed to the sample's time, and smoothed: a body may start with a jolt, an
arm cannot. The smoothed frame catches up with a body of constant velocity completely.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array, norm
from rack.levels.level import Reading
from rack.levels.planning.pose import Pose, pose


class Unfit(Exception):
    """A motion that the arm cannot make; its text says why."""


class WorldSight:
    """The world model as of this cycle, extrapolated."""

    def __init__(self, bodies: tuple[str, ...], blind_s: float, tick_s: float) -> None:
        """See `bodies`, in the model's order; extrapolate for `blind_s` at most."""
        self._bodies = bodies
        self._blind_s = blind_s
        self._tick_s = tick_s
        self._model: Message | None = None

    def look(self, world: Reading) -> None:
        """Take over the newest model."""
        if world.is_there and world.value.revision:
            self._model = world.value

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
        not seen lately."""
        model = self._model
        if model is None:
            raise Unfit("nothing is known of the world")
        ahead_s = time_s - model.sensed * self._tick_s
        velocity = np.array(model.velocity[row]) if ahead_s <= self._blind_s else np.zeros(3)
        place = model.position[row] + model.velocity[row] * min(ahead_s, self._blind_s)
        return pose(place, model.quaternion[row]), velocity


class ToolGoal:
    """The goal of one request."""

    def __init__(self, request: Message, sight: WorldSight, follow_s: float) -> None:
        """Follow a live goal with the time constant `follow_s`."""
        self._goal = pose(request.position, request.quaternion)  # in the frame of the body
        self._body = request.body  # row in the world model; -1: the world
        self.live = request.live > 0 and request.body >= 0
        self._sight = sight
        self._follow_s = follow_s
        self._stamp_s = -1.0  # of the sample for which `pose` was evaluated
        self._frame: Pose | None = None
        self._velocity = np.zeros(3)
        self._turning = np.zeros(3)
        self.pose = self._goal  # of the tool, for that sample

    def update(self, time_s: float) -> None:
        """Evaluate the goal for the sample at `time_s`; again for the same one does nothing. Raises
        `Unfit`."""
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
        unsmoothed."""
        return norm((self._sight.frame(self._body, time_s)[0] @ self._goal).position - position)

    def _followed(self, frame: Pose, seen: Pose, velocity: Array, passed_s: float) -> Pose:
        """Return the frame that goes after the body, critically damped; its turning is followed
        with a lag."""
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
