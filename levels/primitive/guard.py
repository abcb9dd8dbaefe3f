"""The guard: looks along the remaining path, every cycle, for what stands or comes in the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.planning.collision import CollisionChecker
from rack.levels.primitive.grasp import GraspFrame
from rack.levels.primitive.path import BlendedPath
from rack.levels.primitive.segment import Segment
from rack.levels.primitive.trajectory import Trajectory
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

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
"""An obstacle slower than this, along every axis, is at rest."""


class Guard:
    """Watches one path at a time against the world model.

    In every cycle it checks the near way, as far as `lookahead_s` reaches, with every obstacle put where its velocity
    takes it until the arm is there; and a few configurations of the whole remaining path against all bodies as they
    are. These count only while no obstacle moves: what moves may be gone by then. At most 13 checks a cycle.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, lookahead_s: float, delay_s: float) -> None:
        """Look `lookahead_s` ahead; `delay_s` is the time from the sensing of the world to the set point commanded."""
        self._checker = CollisionChecker(cell, scene)
        self._grasps = GraspFrame(cell)
        self._clearance = CLEARANCE_PART * scene.clearance
        self._rows, self._objects = len(scene.bodies), len(scene.objects)
        self._by_themselves = (np.arange(self._rows) >= self._objects)[:, None].astype(float)
        self._delay_s = delay_s
        self._spacing_s = lookahead_s / NEAR_CHECKS
        self._phase = 0
        self._cursor = 0.0
        self._obstructed: float | None = None
        self._least = self._clearance
        self._ahead = np.zeros((self._rows, 3))
        self.obstacle = ""  # the pair of geoms found too close last, with distance and bound

    def carry(self, row: int, q: Array, world: Message) -> None:
        """Take object `row` along with the tool, from where it is while the arm is at `q` (joints,), rad."""
        self._checker.hold(row, *self._grasps.pose_of(world.position[row], world.quaternion[row], q))

    def carry_nothing(self) -> None:
        """Take nothing along."""
        self._checker.hold(None)

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
        self.obstacle = ""

    def is_clear(self, path: BlendedPath, trajectory: Trajectory, time_s: float, world: Message) -> bool:
        """Say, within a cycle's share of the checks, whether nothing is in the way of an arm `time_s` along."""
        begin = trajectory.at(time_s).s
        obstacles = world.velocity[self._objects : self._rows]
        still = bool((np.abs(obstacles) < MOVING_M_S).all())
        self._place(world)
        far_clear = self._far_is_clear(path, begin)
        near_clear = self._near_is_clear(path, trajectory, time_s, world, still)
        return near_clear and (far_clear or not still)

    def _near_is_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, world: Message, still: bool
    ) -> bool:
        self._phase = (self._phase + 1) % PHASES
        for k in range(NEAR_CHECKS):
            ahead_s = (k + (self._phase + 1) / PHASES) * self._spacing_s
            if not still:
                np.multiply(self._by_themselves, ahead_s + self._delay_s, out=self._ahead)
                self._ahead *= world.velocity[: self._rows]
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
        if self._checker.free(path.evaluate(s).q, self._least):
            return True
        self.obstacle = self._checker.nearest()
        return False

    def _place(self, world: Message) -> None:
        self._checker.place(world.position, world.quaternion)
