"""The planner of the task level: plans the whole program as elemental moves, or refuses it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from rack.backplane.message import copy_message
from rack.levels.errors import Refused
from rack.levels.level import Input, LevelContext, Output, Planner, Program
from rack.levels.messages import MOVES, Error, ServoStatus, TaskPlan, TaskStatus, WorldState
from rack.levels.planning.moves import Situation
from rack.levels.robot.cell import build_level_cell
from rack.levels.task.program import ROUNDING_S, TaskConfig, TaskParams, read_program
from rack.levels.task.rehearsal import Rehearsal, Rehearsed, compute_finish_times

MAX_REST_M_S = 0.01
"""Speed below which an object is at rest, so that motions to it can be planned."""


class TaskPlanner(Planner):
    """Plans the program once, when the arm's position is known and the objects are at rest.

    A program that cannot be done is refused before anything moves, with a possible alternative.
    """

    status = Input(TaskStatus, "own.status")
    made = Input(TaskPlan, "own.plan")
    servo = Input(ServoStatus, "servo.status")
    world = Input(WorldState, "world.model")
    output = Output(TaskPlan)
    params: ClassVar[type[TaskParams]] = TaskParams
    settings: TaskParams
    program: ClassVar[type[Program] | None] = TaskConfig

    @classmethod
    def preload(cls) -> None:
        """Load the motion planner once for all boards, because OMPL is slow to import."""
        from rack.levels.planning import motion_planner

        motion_planner.preload()

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        # OMPL takes time and memory to import, so only racks that plan motions import it.
        from rack.levels.planning.motion_planner import MotionPlanner

        self._program = self._read_first_program()
        self._id = 1  # serial of the plan
        self._ahead_s = 0.0  # s: time on the clock of the actions' `by`, minus simulated time
        self._motion = MotionPlanner(build_level_cell(context), context.scene, context.seed)
        self._plan: TaskPlan | None = None  # plan made by this process
        self._visible_at = 0  # tick from which that plan is visible
        self._since: int | None = None  # tick of the first cycle

    def _read_first_program(self) -> TaskConfig:
        """Return the program to plan first."""
        return read_program(self.context.task, self.context.robot, self.context.scene)

    def wanted(self, tick: int) -> bool:
        """Return True if the program has no plan yet, and the world is known and at rest.

        Also return True if the plan of this process has not reached the executor, so that `plan`
        publishes it again.
        """
        self._since = tick if self._since is None else self._since
        followed = self.status.message.echo == self._id
        if not self._program.action or followed or self._may_be_unacknowledged(tick, self._since):
            return False
        if self._plan is not None:
            return True
        if not (self.servo.has_message and self.world.message.revision):
            return False
        objects = len(self.context.scene.objects)
        speeds = np.linalg.norm(self.world.message.velocity[:objects], axis=1)
        return bool(np.all(speeds < MAX_REST_M_S))

    def plan(self, tick: int) -> None:
        """Plan the whole program and write the plan, or the refusal, to `output`.

        If this process has already planned the program, the same plan is published again.
        """
        self._visible_at = tick + self.context.within_cycles * self.context.every
        if self._plan is not None:
            self.output.copy_from(self._plan)
            return
        self.output.clear()
        self.output.id = self._id
        try:
            self._decompose_program(tick)
        except Refused as refused:
            self.output.error = Error(refused.code)
            self.output.reason = self._format_reason(refused)
            self.output.count = 0
        self._plan = copy_message(self.output)

    def _format_reason(self, refused: Refused) -> str:
        """Return the reason why the program is refused, with the number of the action if known."""
        return str(refused) if refused.action is None else f"action {refused.action}, {refused}"

    def _may_be_unacknowledged(self, tick: int, since: int) -> bool:
        """Return True while the executor may not have had time to acknowledge a published plan.

        This process or an earlier one may have published the plan. `since` is the tick of the first
        cycle of this process.
        """
        if self._plan is not None:
            # The status acknowledges a plan one cycle after it becomes visible.
            return tick <= self._visible_at + self.context.every
        # A plan published just before a restart of this planner becomes visible later.
        planning_ticks = self.context.within_cycles * self.context.every
        return self.made.message.id == self._id or 0 < since <= tick < since + planning_ticks

    def _decompose_program(self, tick: int) -> None:
        """Rehearse the program and write its moves into `output`. Raises `Refused`."""
        from rack.levels.task.actions import rehearse

        world = self.world.message
        situation = Situation(np.array(world.position), np.array(world.quaternion))
        start = Rehearsal(self._motion, np.array(self.servo.message.target), situation)
        moves = self._add_deadlines(rehearse(self._program, self.context.scene, start).moves)
        if len(moves) > MOVES:
            raise Refused(
                Error.LIMIT,
                f"the program has {len(moves)} elemental moves; at most {MOVES} are valid",
            )
        self._check_deadlines(moves, self._compute_visible_s(tick))
        for k, (move, _) in enumerate(moves):
            move.write_to(self.output.moves[k])
        self.output.count = len(moves)

    def _compute_visible_s(self, tick: int) -> float:
        """Return the time, in s, at which the level below sees the first moves of a plan.

        `tick` is the tick at which the planner begins the plan.
        """
        # The plan is ready within its cycles, is read and handed down at once, and is visible below
        # a cycle later.
        return (tick + (self.context.within_cycles + 1) * self.context.every) * self.context.tick_s

    def _add_deadlines(self, moves: Sequence[Rehearsed]) -> list[Rehearsed]:
        """Return the moves, with deadlines for the actions that have one.

        The deadline is for the last move of the action. It is one cycle before the action's
        deadline, so that this level can report the action in time.
        """
        timed = list(moves)
        for k, (move, duration_s) in enumerate(moves):
            by_s = self._program.action[move.action].by
            if by_s is not None and (
                k + 1 == len(moves) or moves[k + 1].move.action != move.action
            ):
                timed[k] = Rehearsed(
                    move._replace(by_s=by_s - self._ahead_s - self.context.period_s), duration_s
                )
        return timed

    def _check_deadlines(self, moves: Sequence[Rehearsed], visible_s: float) -> None:
        """Check that every action with a deadline can be completed in time.

        Raises:
            Refused: An action cannot meet its deadline. The text has the earliest possible time.
        """
        finish_s = compute_finish_times(moves, visible_s, self.context, self.settings)
        for (move, _), finished_s in zip(moves, finish_s, strict=True):
            action = self._program.action[move.action]
            earliest_s = finished_s + self._ahead_s
            if move.by_s and action.by is not None and earliest_s > action.by + ROUNDING_S:
                self.output.earliest = earliest_s
                raise Refused(
                    Error.TOO_LATE,
                    f"{action}, by {action.by:g} s: the earliest is {earliest_s:.2f} s",
                    move.action,
                )
