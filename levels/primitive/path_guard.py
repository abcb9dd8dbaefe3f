"""Checks the remaining path for collisions, and the age of the world model used for it."""

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
"""Number of configurations checked per cycle within the look-ahead."""
FAR_CHECKS = 3
"""Number of configurations checked per cycle on the rest of the path."""
PHASES = 4
"""Number of cycles in which the checks within the look-ahead also cover the gaps between them."""
FAR_STEP_RAD = 0.04
"""Spacing of the configurations checked on the rest of the path."""
CLEARANCE_PART = 0.5
"""Part of the planned clearance that must remain, because sensed poses are not exact."""
MAX_REST_M_S = 0.01
"""An obstacle slower than this along every axis counts as at rest."""


class PathGuard:
    """Checks the remaining path for collisions with the bodies of the world model.

    In every cycle it checks the path over the next `lookahead_s`, with every obstacle extrapolated
    by its velocity to the time at which the arm arrives. It also checks a few configurations of the
    rest of the path against all bodies at their present poses. These results count only while no
    obstacle moves, because a moving obstacle may be gone by the time the arm arrives. A cycle makes
    at most 13 checks. Only one path is watched at a time.

    Attributes:
        obstacle: Last pair of geoms found too close, with their distance and the required distance.
    """

    def __init__(
        self,
        cell: Cell,
        scene: SceneConfig,
        lookahead_s: float,
        delay_s: float,
        blind_ticks: int,
    ) -> None:
        """Guard the paths of an arm.

        Args:
            cell: Model of the arm and its surroundings.
            scene: Bodies and clearance.
            lookahead_s: Time ahead of the arm that is checked in every cycle.
            delay_s: Time from the sensing of the world to the set point commanded last.
            blind_ticks: Age from which a scene with bodies is stale.
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
        self._blind_ticks = blind_ticks
        self._blind = self._rows > 0
        self._waiting: tuple[int, int] | None = (
            None  # awaited object, and tick as in `carry_object`
        )
        self.obstacle = ""

    def carry_object(self, row: int, since: int) -> None:
        """Attach an object to the tool in the model, as soon as a new scene shows its pose.

        Args:
            row: Row of the object, or -1 for none.
            since: Earliest tick at which that scene may have been sensed.
        """
        self._waiting = (row, since) if row >= 0 else None
        if row < 0:
            self._checker.hold_object(None)

    def watch_path(
        self, segment: MotionSegment, path: BlendedPath, opening: float, world: WorldState
    ) -> None:
        """Begin to watch the path of a segment.

        Args:
            segment: Segment with the object that may be touched.
            path: Path of the segment.
            opening: Opening of the gripper, m or rad.
            world: Newest world model.
        """
        self._checker.open_gripper(opening)
        row = segment.object if segment.touch and segment.object >= 0 else None
        self._checker.permit_contact(row)
        self._checker.place_bodies(world.position, world.quaternion)
        # Motion may start close to an obstacle, but must not get much closer.
        start_clearance = self._checker.find_clearance(path.evaluate(0.0).q)
        self._least = min(self._clearance, max(start_clearance, 0.0) * CLEARANCE_PART)
        self._obstructed = None
        self._cursor = 0.0
        self.obstacle = ""

    def is_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, world: WorldState
    ) -> bool:
        """Check a few configurations of the path.

        Args:
            path: Watched path.
            trajectory: Trajectory along it.
            time_s: Present time on the trajectory; only later parts are checked.
            world: Newest world model.

        Returns:
            False if a configuration within the look-ahead is blocked or, while no obstacle moves,
            one of the rest of the path.
        """
        begin = trajectory.evaluate_at(time_s).s
        obstacles = world.velocity[self._objects : self._rows]
        still = bool((np.abs(obstacles) < MAX_REST_M_S).all())
        self._checker.place_bodies(world.position, world.quaternion)
        far_clear = self._is_remainder_clear(path, begin)
        moving = None if still else world
        near_clear = self._is_lookahead_clear(path, trajectory, time_s, moving)
        return near_clear and (far_clear or not still)

    def _is_lookahead_clear(
        self, path: BlendedPath, trajectory: Trajectory, time_s: float, moving: WorldState | None
    ) -> bool:
        """Return True if the path within the look-ahead is clear.

        Args:
            path: Watched path.
            trajectory: Trajectory along it.
            time_s: Present time on the trajectory.
            moving: World model from which obstacles are extrapolated. None if none of them moves.
        """
        self._phase = (self._phase + 1) % PHASES
        for k in range(NEAR_CHECKS):
            ahead_s = (k + (self._phase + 1) / PHASES) * self._spacing_s
            if moving is not None:
                travel = self._by_themselves * (ahead_s + self._delay_s) * moving.velocity
                self._checker.place_bodies(moving.position + travel, moving.quaternion)
            if not self._is_free(path, trajectory.evaluate_at(time_s + ahead_s).s):
                return False
            if time_s + ahead_s > trajectory.duration:
                break
        return True

    def _is_remainder_clear(self, path: BlendedPath, begin: float) -> bool:
        """Return True if a few configurations of the rest of the path are clear.

        These are the configuration that was blocked last, and the next few of a cyclic scan.

        Args:
            path: Watched path.
            begin: Path parameter at which the rest of the path begins, rad.
        """
        if self._obstructed is not None and self._obstructed >= begin:
            if not self._is_free(path, self._obstructed):
                return False
            self._obstructed = None
        for _ in range(FAR_CHECKS):
            self._cursor += FAR_STEP_RAD
            if not begin <= self._cursor < path.length + FAR_STEP_RAD:
                self._cursor = begin
            if not self._is_free(path, min(self._cursor, path.length)):
                self._obstructed = self._cursor
                return False
        return True

    def _is_free(self, path: BlendedPath, s: float) -> bool:
        """Return True if the arm is free at path parameter `s`; otherwise set `obstacle`."""
        if self._checker.is_free(path.evaluate(s).q, self._least):
            return True
        self.obstacle = self._checker.describe_worst_pair()
        return False

    def update_scene(self, world: Reading[WorldState], q: Array, tick: int) -> None:
        """Check the age of the world model, and attach a newly held object that it shows.

        The age is the time since its scene was sensed. It also grows if the board of the model runs
        but receives no scene.

        Args:
            world: Newest world model and its verdict.
            q: Position of the arm, (joints,), rad.
            tick: Tick of the cycle.
        """
        model = world.message
        is_seen = model.revision > 0
        is_late = not is_seen or tick - model.sensed > self._blind_ticks
        self._blind = self._rows > 0 and is_late
        if self._waiting is not None and is_seen and model.sensed >= self._waiting[1]:
            row = self._waiting[0]
            pose = Pose(model.position[row], model.quaternion[row])
            self._checker.hold_object(row, *(self._checker.compute_tool_pose(q).inverse() @ pose))
            self._waiting = None

    @property
    def wait_reason(self) -> str:
        """Why motion must wait for a new scene. Empty if it need not wait."""
        if self._blind:
            return "world model is stale: waiting for a new scene"
        return "waiting for a scene that shows the held object" if self._waiting is not None else ""
