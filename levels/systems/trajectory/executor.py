"""The executor of a trajectory level: follows the motion requests of its queue with a set point
every cycle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.level import Executor, Input, Inputs, LevelContext, Output, Reading
from rack.levels.messages import WorldState
from rack.levels.operator import HOLDABLE, OperatorCommand, Orders
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot import dynamics
from rack.levels.robot.cell import cell_of
from rack.levels.robot.dynamics import Dynamics
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.systems.trajectory.boards import HANDOVER_CYCLES, JointBoards
from rack.levels.systems.trajectory.legs import WorldSight
from rack.levels.systems.trajectory.messages import (
    MotionKind,
    MotionRequest,
    MotionState,
    MotionStatus,
)
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.request_work import MotionTools, RequestWork, TrajectoryParams
from rack.levels.systems.trajectory.requests import Agenda
from rack.levels.tables import read_params

LEAD_CYCLES = 2
"""Cycles from the release that makes a set point to the tick at which it is due.

One brings it to the boards that servo joints, which interpolate to it over the second one."""


class TrajectoryExecutor(Executor):
    """Does motion requests in the order of the queue, blended; when it is empty, the arm rests at
    the last goal.

    It needs no board above: what is queued is done. While a board below is lost or stopped, and on
    an operator's hold, the arm rests; the request under way then goes on from there. A request that
    cannot be done ends REFUSED, or FAILED on the way: the arm ramps to rest, all others held are
    CANCELLED, those that come are REFUSED until a CANCEL [assumed]. After a restart the level
    continues with the requests in its own last messages.
    """

    requests = Input(MotionRequest, "above.requests")
    boards = Inputs(JointStatus, "below.status")
    world = Input(WorldState, "world.model")
    last_command = Input(JointReference, "own.command")
    last_status = Input(MotionStatus, "own.status")
    last_state = Input(MotionState, "own.state")
    operator = Input(OperatorCommand, "own.operator")
    command = Output(JointReference)
    status = Output(MotionStatus, rests_on=boards)
    state = Output(MotionState)
    commands = HOLDABLE
    params: ClassVar[type[TrajectoryParams]] = TrajectoryParams
    preloads = (dynamics,)
    work: ClassVar[type[RequestWork]] = RequestWork
    """Does the requests."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(self.params, context.params)
        robot = context.robot
        cell = cell_of(context)
        self._ik = InverseKinematics(cell, context.seed)
        self._sight = WorldSight(context.scene.bodies, params.blind, context.tick_s)
        tools = MotionTools(self._ik, cell.limits, self._sight, params, context.period_s)
        self._agenda = Agenda()
        self._motion = SampledMotion(cell.limits, robot.joints, context.period_s, cell.home)
        self._work = self.work(self._agenda, self._motion, tools)
        self._boards = JointBoards(robot.joints, cell.bounds.position, params.handover)
        self._guard = TouchGuard(context.period_s)
        self._orders = Orders(self.commands)
        self._dynamics = Dynamics(cell)
        if robot.gripper is not None:
            self._work.grip = robot.gripper.open, robot.gripper.force
        self._tick: int | None = None  # of the last cycle
        self._saved: tuple[int, ...] = ()  # what the last state depends on

    def room(self, port: str) -> int:
        """Return how many requests to take: the rest waits in the queue."""
        # None before the level has recalled those that it has already.
        return 0 if self._tick is None else self._agenda.room

    def process(self, tick: int) -> None:
        """Take requests, go on with the motion, write the set point of two cycles later."""
        if self._tick is None:
            self._recall()
            self._tick = tick - self.context.every
        cycles = (tick - self._tick) // self.context.every
        self._tick = tick
        self._orders.take(self.operator)
        self._sight.look(self.world)
        cancelled = self._agenda.take(self.requests)
        if cycles > HANDOVER_CYCLES and self._boards.in_step:
            # The boards hold by now. Across a network their statuses say so too late.
            self._boards.leave(f"{cycles} cycles missed: the boards hold")
            self._work.interrupt()
        self._follow_boards()
        if cancelled:
            self._work.cancel()
        self._watch(cycles)
        hold = self._orders.holds
        # Samples of cycles that were missed are made up, so that no time is lost; beyond a few the
        # boards hold.
        for late in reversed(range(min(cycles, HANDOVER_CYCLES))):
            if self._boards.in_step:
                due = self._due(tick) - late * self.context.every
                self._work.step(due * self.context.tick_s, hold)
        self._write_reference(self.command, tick)
        self._write_status(self.status)
        agenda = self._agenda
        self.state.passed = self._work.passed_s
        goal = 0 if agenda.goal is None else agenda.goal.id
        newest = (agenda.taken, agenda.done, agenda.begun, goal)
        if newest != self._saved:
            self._saved = newest
            agenda.save(self.state)

    def _recall(self) -> None:
        """Continue after a restart, from the level's own last messages."""
        if self.last_state.is_there and self.last_status.is_there:
            self._agenda.recall(self.last_state.message, self.last_status.message)
            self._work.recall(self.last_state.message.passed, self.last_status.message.progress)
        command = self.last_command.message
        if self.last_command.is_there and command.id:
            self._work.grip = command.opening, command.force

    def _follow_boards(self) -> None:
        """Fall out of step with the boards below, or begin anew from where they hold the arm."""
        before = self._boards.in_step
        if self._boards.update(self.boards):
            self._work.interrupt()
            self._motion.rest_at(self._boards.position)
        elif before and not self._boards.in_step:
            self._work.interrupt()

    def _watch(self, cycles: int) -> None:
        """End the request under way if its guard is struck; `cycles` since the last one."""
        current = self._agenda.current
        leg = self._motion.leg
        # At half its speed the arm has long broken away from rest, where friction changes torques.
        steady = cycles == 1 and leg is not None and self._motion.leg_s >= leg.law.half_blend_s
        if current is None or current.kind != MotionKind.POSE or not current.touch or not steady:
            self._guard.begin_anew()
        elif self._guard.is_struck(self.boards, current.touch):
            self._work.end_guarded()

    def _due(self, tick: int) -> int:
        return tick + LEAD_CYCLES * self.context.every

    def _write_reference(self, command: JointReference, tick: int) -> None:
        state = self._motion.state
        command.id = tick // self.context.every + 1
        # Out of step the arm's position is not certain: no set point is better than a wrong one.
        command.due = self._due(tick) if self._boards.in_step else 0
        command.position, command.velocity, command.acceleration = state
        terms = self._dynamics.terms(state.position, state.velocity)
        command.inertia = terms.inertia.diagonal()
        command.load = terms.bias
        command.opening, command.force = self._work.grip
        command.operator = self._orders.rests_on(self._agenda.rests_on)

    def _write_status(self, status: MotionStatus) -> None:
        agenda = self._agenda
        motion = self._motion
        goal = self._work.goal
        agenda.report(status)
        status.echo = agenda.taken
        reason = self._reason_to_wait() if agenda.held or agenda.missing else ""
        if agenda.error:
            status.state = State.ERROR
        elif agenda.held or reason:
            status.state = State.HOLDING if reason else State.EXECUTING
        else:
            status.state = State.DONE if agenda.done else State.IDLE
        status.error = agenda.error
        status.reason = agenda.reason or reason
        status.progress = self._work.progress
        status.resting = motion.resting
        state = motion.state
        status.position = state.position
        status.velocity = state.velocity
        tool = self._ik.tool_at(state.position).position
        status.tool = tool
        status.astray = 0.0
        if goal is not None and goal.live and motion.leg is not None and motion.settled:
            status.astray = goal.astray(tool, motion.time_s)
        if motion.resting:
            self._orders.done()
        self._orders.report(status, agenda.rests_on)

    def _reason_to_wait(self) -> str:
        if not self._boards.in_step:
            return self._boards.awaited
        if self._orders.stands:
            return self._orders.keeps(self.context.board)
        if self._agenda.missing:
            return (
                f"request {self._agenda.taken + 1} is missing: send all again from there, or a"
                " cancel"
            )
        if not self._sight.knows and self._agenda.current is None:
            return "waiting for the world model"
        return ""


LASTS_S = 0.04
"""Parts of the window, at its begin and end, whose medians are compared: what a late cycle or a
short braking leaves behind decays within half of it. The window is five times as long: over more,
slow motion changes torques by itself."""


class TouchGuard:
    """A lasting change of a joint's torque, as where the arm meets something, ends a motion.

    It compares torques, N m, at the end of its window with those at its begin; one sample a cycle.
    They also change when the arm brakes, holds, or goes on after missed cycles: across one of these
    a change is no touch, and the window begins anew.
    """

    def __init__(self, period_s: float) -> None:
        self._lasting = max(round(LASTS_S / period_s), 3)
        self._past: deque[Array] = deque(maxlen=5 * self._lasting)

    def begin_anew(self) -> None:
        """Forget the torques so far."""
        self._past.clear()

    def is_struck(self, boards: Mapping[str, Reading[JointStatus]], most: float) -> bool:
        """Return whether the torque of a joint has changed by more than `most`, N m."""
        if all(board.is_new and not board.message.holding for board in boards.values()):
            self._past.append(np.sum([board.message.torque for board in boards.values()], axis=0))
        else:
            self.begin_anew()
        past = np.array(self._past)
        count = self._lasting
        if len(past) < 2 * count:
            return False
        change = np.median(past[-count:], axis=0) - np.median(past[:count], axis=0)
        return bool(np.abs(change).max() > most)
