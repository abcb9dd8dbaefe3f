"""The guard checks the remaining path in every cycle; sight checks that the world model is recent
enough for motion.
"""

from __future__ import annotations

import numpy as np

from rack.levels.algebra import Array
from rack.levels.level import Reading
from rack.levels.messages import WorldState
from rack.levels.motion.path import BlendedPath
from rack.levels.motion.trajectory import Trajectory
from rack.levels.planning.collision import CollisionChecker
from rack.levels.planning.pose import Pose
from rack.levels.primitive.motion_segment import MotionSegment
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

NEAR_CHECKS = 9
"""Configurations checked per cycle within the look-ahead."""
FAR_CHECKS = 3
"""Configurations checked per cycle on the rest of the path."""
PHASES = 4
"""Cycles over which the near checks step through the gaps between them."""
FAR_STEP_RAD = 0.04
"""Spacing of the configurations on the rest of the path."""
CLEARANCE_PART = 0.5
"""Part of the planned clearance that must be left: sensed poses are not exact."""
MAX_REST_M_S = 0.01
"""An obstacle slower than this, along every axis, is at rest."""


class Guard:
    """Watches one path at a time against the world model.

    In every cycle it checks the path over the next `lookahead_s`, with every obstacle extrapolated
    by its velocity to the time at which the arm arrives, and a few configurations of the whole
    remaining path against all bodies as they are. The latter count only while no obstacle moves: a
    moving one may be gone by then. At most 13 checks per cycle.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, lookahead_s: float, delay_s: float) -> None:
        """Look `lookahead_s` ahead; `delay_s` is the time from sensing the world to the set point
        commanded last.
        """
        self._checker = CollisionChecker(cell, scene)
        self._clearance = CLEARANCE_PART * scene.clearance
        self._rows = len(scene.bodies)
        self._objects = len(scene.objects)
        self._by_themselves = (np.arange(self._rows) >= self._objects)[:, None].astype(float)
        self._delay_s = delay_s
        self._spacing_s = lookahead_s / NEAR_CHECKS
        self._phase = 0
        self._cursor = 0.0
        self._obstructed: float | None = None
        self._least = self._clearance
        self._ahead = np.zeros((self._rows, 3))
        self.obstacle = ""  # the last pair of geoms found too close, with distance and bound

    def carry(self, row: int, q: Array, world: WorldState) -> None:
        """Carry object `row` with the tool, from its pose in `world` while the arm is at `q`
        (joints,), rad.
        """
        seen = Pose(world.position[row], world.quaternion[row])
        self._checker.hold(row, *(self._checker.tool_at(q).inverse() @ seen))

    def carry_nothing(self) -> None:
        """Carry no object."""
        self._checker.hold(None)

    def watch(
        self, segment: MotionSegment, path: BlendedPath, opening: float, world: WorldState
    ) -> None:
        """Begin to watch the path of a segment, with the gripper at `opening`, in m."""
        self._checker.open_gripper(opening)
        row = segment.object if segment.object >= 0 else None
        self._checker.permit(row, segment.touch and row is not None)
        self._checker.place(world.position, world.quaternion)
        # Motion may start too close to something, but must not get closer.
        room = self._checker.room(path.evaluate(0.0).q)
        self._least = min(self._clearance, max(room, 0.0) * CLEARANCE_PART)
        self._obstructed = None
        self._cursor = 0.0
        self.obstacle = ""

    def is_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, world: WorldState
    ) -> bool:
        """Return, by this cycle's share of the checks, whether the path is clear from `time_s`
        on.
        """
        begin = trajectory.at(time_s).s
        obstacles = world.velocity[self._objects : self._rows]
        still = bool((np.abs(obstacles) < MAX_REST_M_S).all())
        self._checker.place(world.position, world.quaternion)
        far_clear = self._far_is_clear(path, begin)
        moving = None if still else world
        near_clear = self._near_is_clear(path, trajectory, time_s, moving)
        return near_clear and (far_clear or not still)

    def _near_is_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, moving: WorldState | None
    ) -> bool:
        """Check the path within the look-ahead; `moving` is the world model while an obstacle
        moves.
        """
        self._phase = (self._phase + 1) % PHASES
        for k in range(NEAR_CHECKS):
            ahead_s = (k + (self._phase + 1) / PHASES) * self._spacing_s
            if moving is not None:
                np.multiply(self._by_themselves, ahead_s + self._delay_s, out=self._ahead)
                self._ahead *= moving.velocity[: self._rows]
                self._ahead += moving.position[: self._rows]
                self._checker.place(self._ahead, moving.quaternion)
            if not self._free(path, trajectory.at(time_s + ahead_s).s):
                return False
            if time_s + ahead_s > trajectory.duration:
                break
        return True

    def _far_is_clear(self, path: BlendedPath, begin: float) -> bool:
        """Check the last configuration found obstructed, then the next few."""
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


class Sight:
    """Holds motion while the world model is stale, and gives the guard the pose of an object in the
    gripper.

    The model may be stale because its board is lost, or because it receives no scene: what counts
    is the time at which the scene was sensed.
    """

    def __init__(self, guard: Guard, blind_ticks: int, has_bodies: bool) -> None:
        """Treat a scene older than `blind_ticks` as unseen; without bodies there is nothing to
        see.
        """
        self._guard = guard
        self._blind_ticks = blind_ticks
        self._has_bodies = has_bodies
        self._blind = has_bodies
        self._waiting: tuple[int, int] | None = None

    def carry(self, row: int, since: int) -> None:
        """Carry object `row` from its pose in a scene sensed at tick `since` or later; -1: carry
        nothing.
        """
        self._waiting = (row, since) if row >= 0 else None
        if row < 0:
            self._guard.carry_nothing()

    def update(self, world: Reading[WorldState], q: Array, tick: int) -> None:
        """Process the newest world model; `q` (joints,), rad, is where the arm rests."""
        model = world.message
        seen = world.is_there and model.revision > 0
        self._blind = self._has_bodies and (not seen or tick - model.sensed > self._blind_ticks)
        if self._waiting is not None and seen and model.sensed >= self._waiting[1]:
            self._guard.carry(self._waiting[0], q, model)
            self._waiting = None

    @property
    def lacks(self) -> str:
        """The reason why motion must wait for a new scene; empty: it need not."""
        if self._blind:
            return "world model is stale: waiting for a new scene"
        return "waiting for a scene that shows the held object" if self._waiting is not None else ""
