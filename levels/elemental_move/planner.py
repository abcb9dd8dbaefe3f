"""The planner of the elemental move level: finds a collision-free path for every move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rack.levels.algebra import Array
from rack.levels.elemental_move.pipeline import ElementalMoveParams, SegmentWindow
from rack.levels.errors import Refused
from rack.levels.level import Input, LevelContext, Output, Planner
from rack.levels.messages import (
    Error,
    MoveCommand,
    MovePlan,
    MoveStatus,
    PrimitiveStatus,
    Scene,
    SegmentKind,
    TaskCommand,
    Verb,
    WorldState,
)
from rack.levels.motion.path import Path
from rack.levels.planning.moves import Move, Situation, read_window
from rack.levels.planning.pose import Pose, make_pose
from rack.levels.robot.cell import build_level_cell

ACKNOWLEDGED_CYCLES = 2
"""Cycles until the status of the executor must acknowledge a plan. Otherwise the plan counts as
lost and is made again."""
MAX_HANDED_DOWN = 1
"""Number of moves after the present one that the executor may have handed down already."""


class PlanningJob(NamedTuple):
    """One plan to make."""

    move: Move
    start: Array  # (joints,), rad
    goal: Array | None = None  # required end, (joints,), rad, or None if free
    request: int = 0  # request of the executor that this job answers, or 0


class PublishedPath(NamedTuple):
    """A path that was handed to the executor."""

    move: Move
    path: Path
    visible_at: int  # tick from which the executor sees it


class Refusal(NamedTuple):
    """A job for which no path was found."""

    move: int
    request: int
    error: int
    revision: int  # revision of the world in which it was tried
    again_at: int  # tick from which it is retried even in an unchanged world


class ElementalMovePlanner(Planner):
    """Plans the path of one move at a time.

    The first priority is a path that the executor requests, the second a path that has become
    blocked, the third the next move without a path. The path of that move begins at the end of the
    previous one. After a restart the planner continues from the status of the executor.
    """

    above = Input(TaskCommand, "above.command")
    status = Input(MoveStatus, "own.status")
    handed_down = Input(MoveCommand, "own.command")
    primitive = Input(PrimitiveStatus, "below.status")
    scene = Input(Scene, "servo.scene")
    world = Input(WorldState, "world.model")
    output = Output(MovePlan)
    params = ElementalMoveParams
    settings: ElementalMoveParams

    @classmethod
    def preload(cls) -> None:
        """Load the motion planner before the fork, because OMPL is slow to import."""
        from rack.levels.planning import motion_planner

        motion_planner.preload()

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        # OMPL takes time and memory to import, so only racks that plan motions import it.
        from rack.levels.planning.motion_planner import MotionPlanner

        self._motion = MotionPlanner(build_level_cell(context), context.scene, context.seed)
        self._published: list[PublishedPath] = []
        self._job: PlanningJob | None = None
        self._window: list[Move] = []
        # Row of the object that is held or will be next, and its pose in the frame of the tool.
        self._grip: tuple[int, Pose] | None = None
        self._revision = -1  # revision of the world in which all published paths are free
        self._refusal: Refusal | None = None  # refusal of the job tried last
        self._tries = 0  # number of tries of that job
        self._answered = 0  # newest request answered
        self._answer_due = 0  # tick by which the executor must have used the answer

    def wanted(self, tick: int) -> bool:
        """Return True if a path must be planned, because it is requested, blocked or missing."""
        ports = (self.above, self.status, self.primitive, self.scene, self.world)
        # A plan for a lost executor would be based on an old status, so wait until it reports.
        if not all(port.has_message for port in ports) or self.status.is_lost:
            return False
        self._window = read_window(self.above.message)
        status = self.status.message
        # Drop paths that are done, or that the executor should have acknowledged but has not.
        late = tick - ACKNOWLEDGED_CYCLES * self.context.every
        open_paths = [p for p in self._published if p.move.id > status.done]
        lost = [
            p.move.id for p in open_paths if p.move.id > status.planned and p.visible_at <= late
        ]
        self._published = [p for p in open_paths if not lost or p.move.id < lost[0]]
        # Compute the grip from the planned grasp of an object that is still at rest or, after a
        # restart, from the sensed pose of an object that is held.
        world = self.world.message
        held = self.primitive.message.held
        if held < 0:
            self._grip = next(
                (
                    (move.object, compute_grip(move.object, move.tool, world))
                    for move in self._window
                    if move.verb is Verb.GRASP and move.id > status.done and move.object is not None
                ),
                None,
            )
        elif self._grip is None or self._grip[0] != held:
            scene = self.scene.message
            tool = make_pose(scene.tool_position, scene.tool_quaternion)
            self._grip = (held, compute_grip(held, tool, scene))
        self._job = (
            self._find_requested_job(tick) or self._find_blocked_job() or self._find_next_job()
        )
        return self._job is not None and self._can_try(self._job, self.world.message.revision, tick)

    def plan(self, tick: int) -> None:
        """Plan the path of one move, or write the reason why it has none."""
        job = self._job
        plan = self.output
        assert job is not None, "plan is called only when one is wanted"
        plan.clear()
        plan.move = job.move.id
        plan.replan = job.request
        visible_at = tick + self.context.every * self.context.within_cycles
        try:
            situation = self._predict_situation(job.move)
            path = self._motion.plan(
                job.move, job.start, situation, attempt=self._tries, goal=job.goal
            )
        except Refused as refused:
            plan.error = Error(refused.code)
            plan.reason = str(refused)
            again_at = visible_at + round(self.settings.retry / self.context.tick_s)
            self._refusal = Refusal(
                job.move.id, job.request, refused.code, self.world.message.revision, again_at
            )
            self._tries += 1
            if not job.request:
                self._published = [p for p in self._published if p.move.id < job.move.id]
            return
        count = len(path.waypoints)
        plan.kind = SegmentKind.PATH
        plan.count = count
        plan.waypoints[:count], plan.blend[:count] = path
        self._record_path(job, path, visible_at)

    def _find_requested_job(self, tick: int) -> PlanningJob | None:
        """Return a job for the path that the executor requests because the arm is blocked, or None.

        The new path must end where the old one ends, so that the paths of later moves remain valid.
        """
        status = self.status.message
        if not status.replan or (status.replan == self._answered and tick < self._answer_due):
            return None
        for move in self._window:
            if move.id == status.current:
                end = SegmentWindow(self.handed_down.message).find_path_end(move.id)
                return PlanningJob(move, np.array(status.start), end, status.replan)
        return None

    def _find_blocked_job(self) -> PlanningJob | None:
        """Return a job for the first later path that a change of the world has blocked, or None.

        The new path must end where the old one ends, so that the paths of later moves remain valid.
        """
        status = self.status.message
        revision = self.world.message.revision
        if revision == self._revision:
            return None
        handed_down = max(status.current, status.done) + MAX_HANDED_DOWN
        for move, path, _ in self._published:
            if move.id > handed_down and not self._motion.is_still_free(
                move, path, self._predict_situation(move)
            ):
                return PlanningJob(move, path.waypoints[0], path.end)
        self._revision = revision
        return None

    def _find_next_job(self) -> PlanningJob | None:
        """Return a job for the first move without a path, or None."""
        status = self.status.message
        primitive = self.primitive.message
        # Prefer the end of a path that the executor reports, because it is exact. But the executor
        # may not have received the newest path yet.
        unseen = [p for p in self._published[-1:] if p.move.id > status.planned]
        move = find_next_motion(self._window, unseen[0].move.id if unseen else status.planned)
        if move is None:
            return None
        if unseen:
            return PlanningJob(move, unseen[0].path.end)
        if status.planned > status.done:
            return PlanningJob(move, np.array(status.end))
        return PlanningJob(move, np.array(primitive.position)) if primitive.resting else None

    def _predict_situation(self, move: Move) -> Situation:
        """Return the situation in which `move` will begin, predicted from the sensed world."""
        world = self.world.message
        held = self.primitive.message.held
        done = self.status.message.done
        situation = Situation(np.array(world.position), np.array(world.quaternion))
        if held >= 0:
            grip = None if self._grip is None else self._grip[1]
            situation = situation.with_object_held(held, grip)
        for earlier in self._window:
            # An object may be reported as held before its grasp is reported as done. Do not apply
            # such a grasp twice.
            is_counted = earlier.verb is Verb.GRASP and earlier.object == situation.held
            if done < earlier.id < move.id and not is_counted:
                situation = situation.predict_after(earlier)
        return situation

    def _can_try(self, job: PlanningJob, revision: int, tick: int) -> bool:
        """Return True if a job is new, or if it was refused and may be tried again.

        A job refused with NO_PATH may be tried again after a change of the world, or after `retry`.

        Args:
            job: Job to try.
            revision: Revision of the newest world model.
            tick: Tick of the cycle.
        """
        refusal = self._refusal
        if refusal is None or (refusal.move, refusal.request) != (job.move.id, job.request):
            self._tries = 0
            return True
        return refusal.error == Error.NO_PATH and (
            revision != refusal.revision or tick >= refusal.again_at
        )

    def _record_path(self, job: PlanningJob, path: Path, visible_at: int) -> None:
        """Record a new path. It replaces an earlier path of the same move.

        Args:
            job: Job for which the path was planned.
            path: The path.
            visible_at: Tick from which the executor sees the path.
        """
        self._refusal = None
        if job.request:
            self._answered = job.request
            self._answer_due = visible_at + ACKNOWLEDGED_CYCLES * self.context.every
        published = PublishedPath(job.move, path, visible_at)
        published_ids = [p.move.id for p in self._published]
        if job.move.id in published_ids:
            self._published[published_ids.index(job.move.id)] = published
        elif not job.request:
            self._published.append(published)


def find_next_motion(window: Sequence[Move], newest: int) -> Move | None:
    """Return the first move after `newest` that needs a path.

    Returns:
        The move, or None if no later move needs a path or the window has a gap before it.
    """
    for move in window:
        if move.id == newest + 1:
            if move.is_motion:
                return move
            newest = move.id
    return None


def compute_grip(row: int, tool: Pose, seen: Scene | WorldState) -> Pose:
    """Return the pose of an object relative to the tool.

    Args:
        row: Row of the object.
        tool: Pose of the tool.
        seen: Scene or world model that contains the object.
    """
    return tool.inverse() @ make_pose(seen.position[row], seen.quaternion[row])
