"""The executor of a trajectory level, which carries out queued motion requests.

It sends a set point in every cycle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.level import OPERATOR, Executor, Input, Inputs, LevelContext, Output, Reading
from rack.levels.messages import Error, WorldState
from rack.levels.operator import HOLD_COMMANDS
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot import dynamics
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.systems.trajectory.boards import HANDOVER_CYCLES, JointBoards
from rack.levels.systems.trajectory.legs import WorldView
from rack.levels.systems.trajectory.messages import (
    MotionKind,
    MotionRequest,
    MotionState,
    MotionStatus,
    RequestEnd,
)
from rack.levels.systems.trajectory.motion import SampledMotion
from rack.levels.systems.trajectory.request_work import MotionTools, RequestWork, TrajectoryParams
from rack.levels.systems.trajectory.requests import Agenda

LEAD_CYCLES = 2
"""Cycles from the release that computes a set point to the tick at which it is due.

The first cycle transports it to the boards that servo joints. During the second they interpolate to
it.
"""


class TrajectoryExecutor(Executor):
    """Carries out motion requests in the order of the queue, and blends them.

    The arm rests at the last goal when the queue is empty. Queued requests are executed even if no
    board is above the level. While a board below is lost or stopped, or an operator holds the
    level, the arm rests, and the current request resumes afterwards. With `after_missed = "hold"`
    the same holds from a missed deadline to a RESUME or a CANCEL. A request that cannot be
    executed ends REFUSED, or FAILED if it had begun: the arm ramps to rest, all other accepted
    requests are CANCELLED, and new ones are REFUSED until a CANCEL [assumed]. After a restart the
    level continues with the requests in its own last messages.
    """

    requests = Input(MotionRequest, "above.requests")
    boards = Inputs(JointStatus, "below.status")
    world = Input(WorldState, "world.model")
    last_command = Input(JointReference, "own.command")
    last_status = Input(MotionStatus, "own.status")
    last_state = Input(MotionState, "own.state")
    operator = OPERATOR
    command = Output(JointReference)
    status = Output(MotionStatus, rests_on=boards)
    state = Output(MotionState)
    commands = HOLD_COMMANDS
    params: ClassVar[type[TrajectoryParams]] = TrajectoryParams
    settings: TrajectoryParams
    preloads = (dynamics,)
    work_class: ClassVar[type[RequestWork]] = RequestWork
    """Class that begins, blends and ends the requests."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        robot = context.robot
        cell = build_level_cell(context)
        self._ik = InverseKinematics(cell, context.seed)
        self._sight = WorldView(context.scene.bodies, params.blind, context.tick_s)
        tools = MotionTools(self._ik, cell.limits, self._sight, params, context.period_s)
        self._agenda = Agenda()
        self._motion = SampledMotion(cell.limits, robot.joints, context.period_s, cell.home)
        self._work = self.work_class(self._agenda, self._motion, tools)
        self._boards = JointBoards(robot.joints, cell.bounds.position, params.handover)
        self._guard = TouchGuard(context.period_s)
        self._dynamics = Dynamics(cell)
        if robot.gripper is not None:
            self._work.grip = robot.gripper.open, robot.gripper.force
        self._last_tick: int | None = None  # of the last cycle; None before the first one
        self._stalled_s = params.stalled
        self._waiting_id = 0  # request whose waits are added up
        self._waited_s = 0.0
        self._failure = ""  # why the arm has to rest after a missed deadline
        # Numbers of requests on which the last saved state depends.
        self._saved_ids: tuple[int, ...] = ()

    def max_messages(self, port: str) -> int:
        """Return how many requests to take from the queue in this cycle. The others stay queued."""
        # Take none before the requests of an earlier process are restored.
        return 0 if self._last_tick is None else self._agenda.remaining_capacity

    def handle_missed_deadline(self, tick: int, skipped: int) -> None:
        """Bring the arm to rest if the parameters demand it."""
        if self.settings.after_missed == "hold" and not self._failure:
            self._failure = (
                f"deadline missed before tick {tick}: `resume` of {self.context.board} or cancel()"
                " ends the hold"
            )

    def process(self, tick: int) -> None:
        """Take requests, advance the motion, and write the set point that is due in two cycles."""
        if self._last_tick is None:
            self._restore_state()
            self._last_tick = tick - self.context.every
        cycles = (tick - self._last_tick) // self.context.every
        self._last_tick = tick
        if self._orders.take_commands(self.operator):
            self._failure = ""
        self._sight.update_model(self.world)
        cancelled = self._agenda.take_new_requests(self.requests)
        if cycles > HANDOVER_CYCLES and self._boards.in_step:
            # By now the boards hold their joints. Over a network, their statuses would arrive too
            # late to show it.
            self._boards.leave_step(f"{cycles} cycles missed: the boards hold")
            self._work.interrupt_motion()
        self._follow_boards()
        if cancelled:
            self._failure = ""
            self._work.cancel_motion()
        self._check_guard(cycles)
        hold = self._orders.is_holding or bool(self._failure)
        # Catch up on the samples of missed cycles, so that the motion is not delayed. After more
        # than a few missed cycles the boards hold.
        for late_cycles in reversed(range(min(cycles, HANDOVER_CYCLES))):
            if self._boards.in_step:
                due_tick = self._compute_due_tick(tick) - late_cycles * self.context.every
                self._work.step(due_tick * self.context.tick_s, hold)
        self._limit_waiting()
        self._write_reference(self.command, tick)
        self._write_status(self.status)
        agenda = self._agenda
        self.state.passed = self._work.passed_s
        goal_id = 0 if agenda.goal is None else agenda.goal.id
        newest_ids = (agenda.taken, agenda.done, agenda.has_begun, goal_id)
        if newest_ids != self._saved_ids:
            self._saved_ids = newest_ids
            agenda.fill_state(self.state)

    def _restore_state(self) -> None:
        """Continue from the level's own last messages after a restart."""
        if self.last_state.has_message and self.last_status.has_message:
            self._agenda.restore_requests(self.last_state.message, self.last_status.message)
            self._work.restore_progress(
                self.last_state.message.passed, self.last_status.message.progress
            )
        command = self.last_command.message
        if self.last_command.has_message and command.id:
            self._work.grip = command.opening, command.force

    def _follow_boards(self) -> None:
        """Interrupt the motion when the boards leave step.

        When they return to step, rest at the positions at which they hold the joints.
        """
        was_in_step = self._boards.in_step
        if self._boards.update(self.boards):
            self._work.interrupt_motion()
            self._motion.rest_at(self._boards.position)
        elif was_in_step and not self._boards.in_step:
            self._work.interrupt_motion()

    def _limit_waiting(self) -> None:
        """Fail a request that has waited for too long in total.

        A boards' hold may end and begin again for ever, so single waits are added up.
        """
        agenda = self._agenda
        first_id = agenda.held[0].id if agenda.held else agenda.taken + 1
        if first_id != self._waiting_id:
            self._waiting_id = first_id
            self._waited_s = 0.0
        has_work = agenda.held or agenda.is_request_missing
        is_stopped = self._orders.is_in_force or self.demand
        if has_work and not is_stopped and (reason := self._find_wait_reason()):
            self._waited_s += self.context.period_s
            if self._waited_s > self._stalled_s and not agenda.error:
                why = f"waited for {self._stalled_s:g} s: {reason}"
                self._work.fail_request(RequestEnd.FAILED, why, Error.STALLED)

    def _check_guard(self, cycles: int) -> None:
        """End the current request if its touch guard detects a contact.

        Args:
            cycles: Cycles since the previous call. The torques are not comparable after missed
                cycles.
        """
        current = self._agenda.current
        leg = self._motion.leg
        # Friction changes the torques while the arm breaks away from rest. This has decayed once
        # the arm has reached half its speed.
        is_steady = cycles == 1 and leg is not None and self._motion.leg_s >= leg.law.half_blend_s
        if current is None or current.kind != MotionKind.POSE or not current.touch or not is_steady:
            self._guard.clear_window()
        elif self._guard.detect_contact(self.boards, current.touch):
            self._work.end_at_guard()

    def _compute_due_tick(self, tick: int) -> int:
        """Return the tick at which the set point of a cycle is due."""
        return tick + LEAD_CYCLES * self.context.every

    def _write_reference(self, command: JointReference, tick: int) -> None:
        """Write the set point with its inertia, load and grip. `due` is 0 while out of step."""
        state = self._motion.state
        command.id = tick // self.context.every + 1
        # Out of step, the arm's position is uncertain. A wrong set point is worse than none.
        command.due = self._compute_due_tick(tick) if self._boards.in_step else 0
        command.position, command.velocity, command.acceleration = state
        terms = self._dynamics.terms(state.position, state.velocity)
        command.inertia = terms.inertia.diagonal()
        command.load = terms.bias
        command.opening, command.force = self._work.grip
        command.operator = self._orders.find_basis(self._agenda.rests_on)

    def _write_status(self, status: MotionStatus) -> None:
        """Write the progress of the requests, the reason for waiting and the state of the arm."""
        agenda = self._agenda
        motion = self._motion
        goal = self._work.goal
        agenda.fill_status(status)
        status.echo = agenda.taken
        reason = self._find_wait_reason() if agenda.held or agenda.is_request_missing else ""
        if agenda.error:
            status.state = State.ERROR
        elif agenda.held or reason:
            status.state = State.HOLDING if reason else State.EXECUTING
        else:
            status.state = State.DONE if agenda.done else State.IDLE
        status.error = agenda.error
        status.reason = agenda.reason or reason
        status.progress = self._work.progress
        status.resting = motion.is_resting
        state = motion.state
        status.position = state.position
        status.velocity = state.velocity
        tool = self._ik.compute_tool_pose(state.position).position
        status.tool = tool
        status.astray = 0.0
        if goal is not None and goal.live and motion.leg is not None and motion.is_settled:
            status.astray = goal.compute_deviation(tool, motion.time_s)
        if motion.is_resting:
            self._orders.report_done()
        self._orders.fill_status(status, agenda.rests_on)

    def _find_wait_reason(self) -> str:
        """Return why the motion does not continue, or an empty string if it does."""
        if self._failure:
            return self._failure
        if not self._boards.in_step:
            return self._boards.wait_reason
        if self._orders.is_in_force:
            return self._orders.format_reason(self.context.board)
        if self._agenda.is_request_missing:
            return (
                f"request {self._agenda.taken + 1} is missing: send all again from there, or a"
                " cancel"
            )
        if not self._sight.has_model and self._agenda.current is None:
            return "waiting for the world model"
        return ""


MEDIAN_WINDOW_S = 0.04
"""Length of the two medians that are compared, at the start and end of the window, s.

Effects of a late cycle or a short braking decay within half of it. The window is five times as
long. In a longer window, slow motion alone would change the torques.
"""


class TouchGuard:
    """Detects contact of the arm by a lasting change of a joint's torque.

    It compares the torques, N m, at the end of its window with those at the start, one sample per
    cycle. Torques also change when the arm brakes, holds, or continues after missed cycles. Such a
    change is not a contact, and therefore clears the window.
    """

    def __init__(self, period_s: float) -> None:
        self._median_samples = max(round(MEDIAN_WINDOW_S / period_s), 3)
        self._torques: deque[Array] = deque(maxlen=5 * self._median_samples)

    def clear_window(self) -> None:
        """Discard the torques collected so far."""
        self._torques.clear()

    def detect_contact(self, boards: Mapping[str, Reading[JointStatus]], max_change: float) -> bool:
        """Add the torques of this cycle to the window, and compare its end with its start.

        Args:
            boards: Statuses of the boards that servo joints.
            max_change: Largest change of a joint's torque without contact, N m.

        Returns:
            True if the torque of a joint has changed by more than `max_change`.
        """
        if all(board.is_new and not board.message.holding for board in boards.values()):
            self._torques.append(
                np.sum([board.message.torque for board in boards.values()], axis=0)
            )
        else:
            self.clear_window()
        past = np.array(self._torques)
        count = self._median_samples
        if len(past) < 2 * count:
            return False
        change = np.median(past[-count:], axis=0) - np.median(past[:count], axis=0)
        return bool(np.abs(change).max() > max_change)
