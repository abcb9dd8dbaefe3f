"""The planner of the elemental move level: a collision-free path for every move, ahead of its turn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message, MessageType
from rack.levels.elemental_move.lookahead import Job, Published, Refusal, end_handed_down, next_move, situation_before
from rack.levels.elemental_move.params import ElementalMoveParams
from rack.levels.errors import Refused
from rack.levels.level import Input, LevelContext, Planner, Ports
from rack.levels.messages import (
    MOVE_COMMAND,
    MOVE_PLAN,
    MOVE_STATUS,
    PRIMITIVE_STATUS,
    SCENE,
    TASK_COMMAND,
    WORLD_MODEL,
    Error,
    SegmentKind,
    Verb,
)
from rack.levels.planning.move import Move, read_window
from rack.levels.planning.path import Path
from rack.levels.planning.pose import Pose, pose
from rack.levels.planning.situation import Situation
from rack.levels.robot.cell import build_cell
from rack.levels.tables import read_params

Array = NDArray[np.float64]

ACKNOWLEDGED_CYCLES = 2
"""Cycles until the executor's status must show a plan that it has seen; else the plan is lost and made again."""
HANDED_DOWN = 1
"""Moves behind the one under way that the executor may have handed down already."""


class ElementalMovePlanner(Planner):
    """Plans one move a time, the next one whose path is not yet there, from where the one before it will end.

    All it needs to go on after a restart stands in the executor's status.
    """

    inputs: ClassVar[Mapping[str, Input]] = {
        "command": Input(TASK_COMMAND, "above.command"),
        "status": Input(MOVE_STATUS, "own.status"),
        "handed_down": Input(MOVE_COMMAND, "own.command"),
        "primitive": Input(PRIMITIVE_STATUS, "below.status"),
        "scene": Input(SCENE, "servo.scene"),
        "world": Input(WORLD_MODEL, "world.model"),
    }
    output: ClassVar[MessageType] = MOVE_PLAN
    params = ElementalMoveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        # OMPL takes time and memory to import: the process of a planner pays, no other.
        from rack.levels.planning.motion import MotionPlanner

        self._params = read_params(ElementalMoveParams, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._motion = MotionPlanner(cell, context.scene, context.seed)
        self._published: list[Published] = []
        self._job: Job | None = None
        self._window: list[Move] = []
        self._grip: tuple[int, Pose] | None = None
        self._revision = -1
        self._refusal: Refusal | None = None
        self._tries = 0
        self._answered = 0
        self._answer_due = 0

    def wanted(self, read: Ports, tick: int) -> bool:
        """Say whether a path is asked for, is blocked, or is not yet there."""
        ports = (read.command, read.status, read.primitive, read.scene, read.world)
        # What is planned for an executor that is lost rests on what it knew: it says anew when it is back.
        if not all(port.is_there for port in ports) or read.status.is_lost:
            return False
        self._window = read_window(read.command.value)
        status = read.status.value
        self._forget(status, tick)
        self._note_grip(read)
        self._job = self._asked_for(read, tick) or self._blocked(read) or self._ahead(read)
        return self._job is not None and self._may_try(self._job, read.world.value.revision, tick)

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Make the path of one move, or say why there is none."""
        job = self._job
        assert job is not None, "plan is called only when one is wanted"
        write.clear()
        write.move, write.replan = job.move.id, job.request
        visible_at = tick + self.context.every * self.context.within_cycles
        try:
            path = self._motion.plan(job.move, job.start, self._situation(job.move, read), self._tries, job.goal)
        except Refused as refused:
            write.error, write.reason = refused.code, str(refused)
            self._note_refusal(job, refused, read.world.value.revision, visible_at)
            return
        count = len(path.waypoints)
        write.kind, write.count = SegmentKind.PATH, count
        write.waypoints[:count], write.blend[:count] = path
        self._note_path(job, path, visible_at)

    def _asked_for(self, read: Ports, tick: int) -> Job | None:
        """Return the job that the executor asks for where the arm is blocked; its end stays, for what comes behind."""
        status = read.status.value
        if not status.replan or (status.replan == self._answered and tick < self._answer_due):
            return None
        for move in self._window:
            if move.id == status.current:
                return Job(move, np.array(status.start), end_handed_down(read.handed_down.value, move), status.replan)
        return None

    def _blocked(self, read: Ports) -> Job | None:
        """Return the first path ahead that a change of the world has blocked; its end stays."""
        status, revision = read.status.value, read.world.value.revision
        if revision == self._revision:
            return None
        handed_down = max(status.current, status.done) + HANDED_DOWN
        for move, path, _ in self._published:
            if move.id > handed_down and not self._motion.still_free(move, path, self._situation(move, read)):
                return Job(move, path.waypoints[0], path.end)
        self._revision = revision
        return None

    def _ahead(self, read: Ports) -> Job | None:
        """Return the first move without a path."""
        status, primitive = read.status.value, read.primitive.value
        newest = max(status.planned, self._published[-1].move.id if self._published else 0)
        move = next_move(self._window, newest)
        if move is None:
            return None
        # What the executor has it knows better: it may not have taken the newest path made.
        if self._published and self._published[-1].move.id > status.planned:
            return Job(move, self._published[-1].path.end)
        if status.planned > status.done:
            return Job(move, np.array(status.end))
        return Job(move, np.array(primitive.position)) if primitive.resting else None

    def _situation(self, move: Move, read: Ports) -> Situation:
        grip = self._grip[1] if self._grip is not None else None
        return situation_before(
            move, self._window, read.world.value, read.primitive.value.held, grip, read.status.value.done
        )

    def _forget(self, status: Message, tick: int) -> None:
        """Forget paths that are done, and those that the executor does not have although it should."""
        late = tick - ACKNOWLEDGED_CYCLES * self.context.every
        kept = [p for p in self._published if p.move.id > status.done]
        lost = [p.move.id for p in kept if p.move.id > status.planned and p.visible_at <= late]
        self._published = [p for p in kept if not lost or p.move.id < lost[0]]

    def _note_grip(self, read: Ports) -> None:
        """Remember how the object will be grasped while it still rests; after a restart, see how it is held."""
        world, held, done = read.world.value, read.primitive.value.held, read.status.value.done
        if held < 0:
            ahead = [(m.object, m.tool) for m in self._window if m.verb is Verb.GRASP and m.id > done]
            self._grip = next(((row, grip_of(row, tool, world)) for row, tool in ahead if row is not None), None)
        elif self._grip is None or self._grip[0] != held:
            scene = read.scene.value
            tool = pose(scene.tool_position, scene.tool_quaternion)
            self._grip = (held, grip_of(held, tool, scene))

    def _may_try(self, job: Job, revision: int, tick: int) -> bool:
        """Say whether a job may be tried: at once, or again when the world has changed or time has passed."""
        refusal = self._refusal
        if refusal is None or (refusal.move, refusal.request) != (job.move.id, job.request):
            self._tries = 0
            return True
        return refusal.error == Error.NO_PATH and (revision != refusal.revision or tick >= refusal.again_at)

    def _note_refusal(self, job: Job, refused: Refused, revision: int, visible_at: int) -> None:
        again_at = visible_at + round(self._params.retry / self.context.tick_s)
        self._refusal = Refusal(job.move.id, job.request, refused.code, revision, again_at)
        self._tries += 1
        if not job.request:
            self._published = [p for p in self._published if p.move.id < job.move.id]

    def _note_path(self, job: Job, path: Path, visible_at: int) -> None:
        self._refusal = None
        if job.request:
            self._answered = job.request
            self._answer_due = visible_at + ACKNOWLEDGED_CYCLES * self.context.every
        published = Published(job.move, path, visible_at)
        known = [p.move.id for p in self._published]
        if job.move.id in known:
            self._published[known.index(job.move.id)] = published
        elif not job.request:
            self._published.append(published)


def grip_of(row: int, tool: Pose, seen: Message) -> Pose:
    """Return the pose of object `row` in the frame of a tool at `tool`; `seen` is a SCENE or a WORLD_MODEL."""
    return tool.inverse() @ pose(seen.position[row], seen.quaternion[row])
