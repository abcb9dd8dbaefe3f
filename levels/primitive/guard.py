"""The guard: looks along the remaining path, every cycle, for what stands or comes in the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backplane.message import Message
from levels.cell import Cell
from levels.planning.collision import CollisionChecker
from levels.primitive.grasp import GraspFrame
from levels.primitive.path import BlendedPath
from levels.primitive.segment import Segment
from levels.primitive.trajectory import Trajectory
from levels.scene import SceneConfig

Array = NDArray[np.float64]

NEAR_CHECKS = 9
"""Configurations checked in a cycle on the way that lies within the look-ahead."""
FAR_CHECKS = 3
"""Configurations checked in a cycle on the rest of the path."""
PHASES = 4
"""Cycles over which the near checks step through the gaps between them."""
FAR_STEP_RAD = 0.04
"""Spacing of the configurations on the rest of the path."""
CLEARANCE_PART = 0.5
"""Part of the planned clearance that must be left: sensed poses are not exact."""
MOVING_M_S = 0.01
"""A body slower than this is at rest."""


class Guard:
    """Watches one path at a time against the world model.

    In every cycle it checks the near way, as far as `lookahead_s` reaches, with every body put where its velocity takes it
    until the arm is there; and a few configurations of the whole remaining path against the bodies as they are. These
    count only while no body moves: what moves may be gone by then. At most 13 checks a cycle.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, lookahead_s: float) -> None:
        self._checker = CollisionChecker(cell, scene)
        self._grasps = GraspFrame(cell)
        self._clearance = CLEARANCE_PART * scene.clearance
        self._rows = len(scene.bodies)
        self._lookahead_s = lookahead_s
        self._spacing_s = lookahead_s / NEAR_CHECKS
        self._phase = 0
        self._cursor = 0.0
        self._obstructed: float | None = None
        self._least = self._clearance
        self._held: int | None = None
        self._ahead = np.zeros((self._rows, 3))

    def carry(self, row: int | None, q: Array, world: Message) -> None:
        """Take object `row` along with the tool, from where it is while the arm is at `q`; None: carry nothing."""
        self._held = row
        if row is None:
            self._checker.hold(None)
        else:
            self._checker.hold(row, *self._grasps.pose_of(world.position[row], world.quaternion[row], q))

    def watch(self, segment: Segment, path: BlendedPath, opening: float, world: Message) -> None:
        """Begin to watch a new path, to be gone with the gripper at `opening`, in m."""
        self._checker.open_gripper(opening)
        self._checker.permit(segment.object, segment.touch and segment.object is not None)
        self._place(world)
        # What is too close at the start, the motion may leave; it must not come closer.
        room = self._checker.room(path.evaluate(0.0).q)
        self._least = min(self._clearance, max(room, 0.0) * CLEARANCE_PART)
        self._obstructed = None
        self._cursor = 0.0

    def is_clear(self, path: BlendedPath, begin: float, trajectory: Trajectory | None, time_s: float, world: Message) -> bool:
        """Say, within a cycle's share of the checks, whether nothing is in the way.

        The arm is `time_s` along `trajectory`, or rests at `begin` without one.
        """
        velocity = world.velocity[: self._rows]
        moving = np.linalg.norm(velocity, axis=1) > MOVING_M_S
        if self._held is not None:
            moving[self._held] = False
        self._place(world)
        far_clear = self._far_is_clear(path, begin)
        near_clear = True
        if trajectory is not None:
            near_clear = self._near_is_clear(path, trajectory, time_s, world, velocity * moving[:, None])
        return near_clear and (far_clear or bool(moving.any()))

    def _near_is_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, world: Message, velocity: Array
    ) -> bool:
        still = not velocity.any()
        self._phase = (self._phase + 1) % PHASES
        for k in range(NEAR_CHECKS):
            ahead_s = (k + (self._phase + 1) / PHASES) * self._spacing_s
            if not still:
                np.multiply(velocity, ahead_s, out=self._ahead)
                self._ahead += world.position[: self._rows]
                self._checker.place(self._ahead, world.quaternion)
            if not self._free(path, trajectory.at(time_s + ahead_s).s):
                return False
            if time_s + ahead_s > trajectory.duration:
                break
        return True

    def _far_is_clear(self, path: BlendedPath, begin: float) -> bool:
        """Check the next few configurations, first the one that was found obstructed."""
        if self._obstructed is not None and self._obstructed >= begin:
            if not self._free(path, self._obstructed):
                return False
            self._obstructed = None
        for _ in range(FAR_CHECKS):
            self._cursor += FAR_STEP_RAD
            if not begin <= self._cursor < path.length + FAR_STEP_RAD:
                self._cursor = begin
            if not self._free(path, min(self._cursor, path.length)):
                self._obstructed = self._cursor
                return False
        return True

    def _free(self, path: BlendedPath, s: float) -> bool:
        return self._checker.free(path.evaluate(s).q, self._least)

    def _place(self, world: Message) -> None:
        self._checker.place(world.position, world.quaternion)
