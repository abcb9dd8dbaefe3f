"""The planning level above a trajectory level, which queues motion requests for a program.

The program is in `[task]`. RCCL's user program made its motion requests asynchronously [S3], and
copied their parameters when it queued them; only live goals could still change [assumed]. The
planner does the same in the background, and its plan is the queue. The executor only reports the
progress of the program.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.level import (
    Executor,
    Input,
    LevelContext,
    Mismatches,
    Output,
    Planner,
    Program,
    QueuedOutput,
)
from rack.levels.messages import TaskStatus, WorldState
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, make_pose
from rack.levels.robot.cell import build_level_cell
from rack.levels.systems.trajectory.messages import (
    MAX_HELD_REQUESTS,
    MotionKind,
    MotionRequest,
    MotionStatus,
)
from rack.levels.tables import (
    Finite,
    NotNegative,
    Positive,
    Quaternion,
    RobotConfig,
    SceneConfig,
    Table,
    Vector,
)

MAX_REQUESTS = 200


class MotionStep(Table):
    """Base of the steps that move the arm."""

    segment: NotNegative = 0.0
    """time of the segment [s]; 0 chooses it from the limits, and too short a time is stretched"""
    acceleration: NotNegative = 0.0
    """half the time of the blend into the segment [s]; 0 for the level's default"""


class HomeStep(MotionStep):
    """Move the joints to the arm's start position."""

    do: Literal["home"] = "home"
    """the kind of step"""


class MoveStep(MotionStep):
    """Move straight in joint space, to joint positions or to a pose of the tool."""

    do: Literal["move"] = "move"
    """the kind of step"""
    joints: tuple[Finite, ...] | None = None
    """joint positions [rad]"""
    position: Vector | None = None
    """position of the tool [m]"""
    quaternion: Quaternion | None = None
    """orientation of the tool, as w, x, y, z; by default as at home"""

    @model_validator(mode="after")
    def _check_one_goal(self) -> MoveStep:
        """Require either `position` or `joints`, and a `quaternion` only with `position`."""
        if (self.position is None) == (self.joints is None):
            raise ValueError("a move has either position or joints")
        if self.quaternion is not None and (self.position is None or not any(self.quaternion)):
            raise ValueError("a quaternion belongs to a position, and is not all zero")
        return self


class LineStep(MotionStep):
    """Move the tool along a straight line to a pose.

    The pose is in the world or in the frame of a body, which it may follow.
    """

    do: Literal["line"] = "line"
    """the kind of step"""
    position: Vector
    """position of the tool [m], in the frame of `body`"""
    quaternion: Quaternion | None = None
    """orientation of the tool in the same frame, as w, x, y, z; by default as at home"""
    body: str | None = None
    """object or obstacle in whose frame the goal is; by default the world"""
    live: bool = False
    """whether the goal follows the body; otherwise its frame is copied when the motion begins"""

    @model_validator(mode="after")
    def _check_live_goal(self) -> LineStep:
        """Require a body for a live goal, and a quaternion that is not all zero."""
        if self.live and self.body is None:
            raise ValueError("a live goal needs a body that it follows")
        if self.quaternion is not None and not any(self.quaternion):
            raise ValueError("quaternion is all zero; its length must not be zero")
        return self


class StayStep(Table):
    """Stay at the previous goal, and follow it if it is live."""

    do: Literal["stay"] = "stay"
    """the kind of step"""
    seconds: Positive
    """duration [s]"""


class GripStep(Table):
    """Move the gripper to an opening, with the arm at rest."""

    do: Literal["grip"] = "grip"
    """the kind of step"""
    opening: Finite
    """gripper joint position [m or rad]"""
    force: Positive | None = None
    """largest force [N or N m]; by default the gripper's force"""
    seconds: NotNegative = 0.0
    """time for the motion [s]; 0 for the level's default"""


class MeetStep(Table):
    """Wait at the previous goal for another arm, and begin the next step together with it."""

    do: Literal["meet"] = "meet"
    """the kind of step"""


class CancelStep(Table):
    """Cancel all requests under way or queued. The arm ramps to rest."""

    do: Literal["cancel"] = "cancel"
    """the kind of step"""
    after: NotNegative
    """time since the previous step began [s]"""


Step = MoveStep | LineStep | HomeStep | StayStep | GripStep | MeetStep | CancelStep


class MotionProgram(Program):
    """Program of steps. Step k, counted from 0, becomes request k + 1."""

    step: tuple[Annotated[Step, Field(discriminator="do")], ...] = Field(
        (), max_length=MAX_REQUESTS
    )
    """steps, in the order of execution"""

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield the key, value and reason of each entry that does not match arm or scene."""
        if robot is None:
            return
        for k, step in enumerate(self.step):
            if (
                isinstance(step, MoveStep)
                and step.joints is not None
                and len(step.joints) != len(robot.joints)
            ):
                why = f"has {len(step.joints)} values; must have {len(robot.joints)}, one per joint"
                yield f"step[{k}].joints", list(step.joints), why
            if isinstance(step, LineStep) and step.body not in (None, *scene.bodies):
                why = f"not in the scene; bodies: {', '.join(scene.bodies) or 'none'}"
                yield f"step[{k}].body", step.body, why
            if isinstance(step, GripStep) and robot.gripper is None:
                yield f"step[{k}].do", step.do, "the robot has no gripper"


MAX_REQUESTS_PER_PLAN = 2
"""Largest number of requests made by one plan."""
RESEND_DELAY_S = 0.5
"""Time after which a request that the level below has not taken is sent again, s.

It may have been lost.
"""


class PlanningParams(Table):
    """`[board.<name>.params]`: how far the planner works ahead."""

    ahead: int = Field(4, ge=1, le=MAX_HELD_REQUESTS)
    """largest number of requests queued or under way at the same time"""


class RequestExecutor(Executor):
    """Reports the progress of the program and the error that ended it.

    It takes no operator commands, because the trajectory level takes them.
    """

    below = Input(MotionStatus, "below.status")
    status = Output(TaskStatus, rests_on=below)
    params = PlanningParams
    program = MotionProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._count = len(self.program.read(context.task, context.robot, context.scene).step)

    def process(self, tick: int) -> None:
        """Report how many requests are done, and the state of the level below."""
        below = self.below.message
        status = self.status
        status.echo = below.echo
        status.operator = below.operator
        status.action = status.moves_done = min(below.done, self._count)
        status.actions = status.moves = self._count
        status.error = below.error
        status.reason = below.reason
        if below.error:
            status.state = State.ERROR
        elif not self._count:
            status.state = State.IDLE
        elif below.done >= self._count:
            status.state = State.DONE
        else:
            status.state = State.HOLDING if below.state == State.HOLDING else State.EXECUTING


class RequestPlanner(Planner):
    """Makes a request from each step of the program, a few steps ahead of the arm.

    The request of step k has the id k + 1. A restarted planner therefore continues after the newest
    request that the level below has taken. A request that was sent twice is carried out once, and
    one that was lost is sent again. If no joint positions are found for a tool goal, the request is
    queued anyway: the level below refuses it with the reason.
    """

    below = Input(MotionStatus, "below.status")
    world = Input(WorldState, "world.model")
    output = QueuedOutput(MotionRequest)
    params = PlanningParams
    settings: PlanningParams
    program = MotionProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._steps = self.program.read(context.task, context.robot, context.scene).step
        cell = build_level_cell(context)
        self._ik = InverseKinematics(cell, context.seed)
        self._home = cell.home
        self._home_quaternion = self._ik.compute_tool_pose(cell.home).quaternion
        self._bodies = context.scene.bodies
        # Joint positions at the end of each planned step, (joints,), rad.
        self._goals: dict[int, Array] = {}
        self._sent = 0  # newest request queued, or taken below
        self._taken = 0  # newest request taken below
        self._taken_tick = 0  # tick at which `_taken` or `_sent` changed
        self._begun = 0  # newest request begun below
        self._begun_tick = 0  # tick at which `_begun` changed

    def wanted(self, tick: int) -> bool:
        """Return True if a step may be planned now.

        Also records which requests the level below has taken and begun, and schedules lost requests
        to be sent again.
        """
        below = self.below.message
        if not self.below.has_message or below.error:
            return False
        begun = max(below.current, below.done)
        if begun != self._begun:
            self._begun = begun
            self._begun_tick = tick
        self._sent = max(self._sent, below.taken)
        if below.taken != self._taken:
            self._taken = below.taken
            self._taken_tick = tick
        waited_s = (tick - self._taken_tick) * self.context.tick_s
        if below.taken < self._sent and waited_s > RESEND_DELAY_S and not self.below.is_lost:
            self._sent = below.taken
            self._taken_tick = tick
        return self._can_send(below.done, tick)

    def plan(self, tick: int) -> None:
        """Plan the next steps and queue their requests."""
        for _ in range(MAX_REQUESTS_PER_PLAN):
            if not self._can_send(self.below.message.done, tick):
                return
            self._fill_request(self.output.message, self._sent, self.world.message)
            if not self.output.send():
                return
            self._sent += 1
            self._taken_tick = tick

    def _can_send(self, done: int, tick: int) -> bool:
        """Return True if the next step may be queued now.

        Args:
            done: Newest request ended by the level below.
            tick: Current tick, for the delay of a cancel step.
        """
        sent = self._sent
        if sent >= len(self._steps) or sent - done >= self.settings.ahead:
            return False
        step = self._steps[sent]
        if not isinstance(step, CancelStep):
            return True
        begun_s = (tick - self._begun_tick) * self.context.tick_s
        return self._begun >= sent and begun_s >= step.after

    def _fill_request(self, request: MotionRequest, k: int, world: WorldState) -> None:
        """Fill in the request of step k."""
        step = self._steps[k]
        self._goals[k] = self._compute_goal(k, world)
        request.clear()
        request.id = k + 1
        request.body = -1
        if isinstance(step, MotionStep):
            request.segment = step.segment
            request.acceleration = step.acceleration
            joints = self._goals[k]
            tool = self._find_tool_pose(step)
            is_solved = joints is not self._find_goal_before(k, world)
            if tool is None or (isinstance(step, MoveStep) and is_solved):
                request.kind = MotionKind.JOINTS
                request.joints = joints
            else:
                request.kind = MotionKind.POSE
                request.position, request.quaternion = tool
            if isinstance(step, LineStep) and step.body is not None:
                request.body = self._bodies.index(step.body)
                request.live = step.live
        elif isinstance(step, StayStep):
            request.kind = MotionKind.STAY
            request.segment = step.seconds
        elif isinstance(step, GripStep):
            gripper = self.context.robot.gripper
            default = gripper.force if gripper is not None else 0.0
            request.kind = MotionKind.GRIP
            request.segment = step.seconds
            request.opening = step.opening
            request.force = default if step.force is None else step.force
        elif isinstance(step, MeetStep):
            request.kind = MotionKind.MEET
        else:
            request.kind = MotionKind.CANCEL

    def _find_goal_before(self, k: int, world: WorldState) -> Array:
        """Return the joint positions at the end of the step before step k.

        The goal is computed if it is not known, for example after a restart.
        """
        if k == 0:
            return self._home
        if k - 1 not in self._goals:
            self._goals[k - 1] = self._compute_goal(k - 1, world)
        return self._goals[k - 1]

    def _compute_goal(self, k: int, world: WorldState) -> Array:
        """Return the joint positions at the end of step k.

        If the step does not move the arm, or no positions are found, the previous ones are
        returned.
        """
        step = self._steps[k]
        previous = self._find_goal_before(k, world)
        if isinstance(step, HomeStep):
            return self._home
        if isinstance(step, MoveStep) and step.joints is not None:
            return np.array(step.joints)
        target = self._find_tool_pose(step)
        if target is None:
            return previous
        if isinstance(step, LineStep) and step.body is not None:
            if not world.revision:
                return previous
            row = self._bodies.index(step.body)
            target = make_pose(world.position[row], world.quaternion[row]) @ target
        joints = self._ik.find_configuration(target, previous)
        if joints is not None:
            return joints
        solutions = self._ik.find_solutions(target, previous)
        return solutions[0] if solutions else previous

    def _find_tool_pose(self, step: Step) -> Pose | None:
        """Return the pose of the tool at the goal of a step, in the step's frame.

        None if the step gives no pose.
        """
        if not isinstance(step, MoveStep | LineStep) or step.position is None:
            return None
        quaternion = self._home_quaternion if step.quaternion is None else step.quaternion
        return make_pose(step.position, quaternion)
