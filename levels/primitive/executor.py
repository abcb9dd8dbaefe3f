"""The executor of the primitive level: writes a joint set point in every cycle.

The set points follow paths that the planner has timed.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import State
from rack.levels.level import OPERATOR, Executor, Input, LevelContext, Output
from rack.levels.messages import (
    Error,
    JointCommand,
    MoveCommand,
    PrimitiveStatus,
    SegmentKind,
    ServoStatus,
    TrajectoryPlan,
    WorldState,
)
from rack.levels.motion import path as paths
from rack.levels.operator import ABOVE_LOST, HELD_FROM_ABOVE, HOLD_COMMANDS
from rack.levels.planning import collision
from rack.levels.primitive.motion_segment import (
    MotionSegment,
    SegmentFault,
    list_serials,
    read_segment,
)
from rack.levels.primitive.path_guard import PathGuard
from rack.levels.primitive.path_motion import JointSetPoint
from rack.levels.primitive.planner import Plans
from rack.levels.primitive.segment_work import (
    GripperWork,
    PathWork,
    PrimitiveParams,
    WorkRules,
)
from rack.levels.primitive.tracking import (
    LEAD_CYCLES,
    MAX_UNEXPLAINED_CYCLES,
    SEEN_CYCLES,
    DeviationMonitor,
    Tracking,
)
from rack.levels.robot.cell import build_level_cell

Work = PathWork | GripperWork

DELAY_CYCLES = SEEN_CYCLES + LEAD_CYCLES - 1
"""Cycles from the sensing of the world model to the set point commanded last. Bodies keep moving
during this time."""


class PrimitiveExecutor(Executor):
    """Executes the segments of the window in order, while the planner prepares the next one.

    Every segment begins and ends at rest. A set point is due `LEAD_CYCLES` cycles after the cycle
    that writes it. After a restart the level restores its state from its own last messages. It
    brings the arm to rest on its path while the board above is lost, or while the level above or an
    operator commands `hold`. While the servo level does not follow set points, it waits.
    """

    above = Input(MoveCommand, "above.command")
    below = Input(ServoStatus, "below.status")
    plan = Input(TrajectoryPlan, "own.plan")
    world = Input(WorldState, "world.model")
    last_command = Input(JointCommand, "own.command")
    last_status = Input(PrimitiveStatus, "own.status")
    operator = OPERATOR
    command = Output(JointCommand, rests_on=above)
    status = Output(PrimitiveStatus, rests_on=below)
    commands = HOLD_COMMANDS
    preloads = (collision, paths)
    params = PrimitiveParams
    settings: PrimitiveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        cell = build_level_cell(context)
        self._rules = WorkRules(context.robot.joints, cell.limits, params, context.period_s)
        self._guard = PathGuard(
            cell,
            context.scene,
            params.lookahead,
            DELAY_CYCLES * context.period_s,
            round(params.blind / context.tick_s),
        )
        self._gripper = context.robot.gripper
        self._tracking = Tracking()
        self._straying = DeviationMonitor(
            context.robot.joints, params.following, self._rules.count_cycles(params.straying)
        )
        self._plans = Plans()
        # The state with which the executor continues after a restart is in its last messages.
        self._is_known = False  # the level was in step with the servo, perhaps before a restart
        self._interrupted = 0  # serial of the interrupted segment, or 0
        self._progress = 0.0  # part of that segment's path done, 0 to 1
        self._work: Work | None = None
        self._fault: SegmentFault | None = None
        self._begun = 0  # serial of the last segment that was begun
        self._position = cell.home.copy()  # (joints,), rad: last position commanded
        self._rest = JointSetPoint(self._position, *np.zeros((2, len(cell.home))))
        self._tick: int | None = None  # tick of the last cycle
        # The servo was out of step since the last path, so the arm may not be at its end.
        self._displaced = False

    def process(self, tick: int) -> None:
        """Run one cycle: read all inputs, advance the segment, write set point and status."""
        if self._tick is None:
            self._tick = tick - self.context.every
            self._restore_state()
        passed_s = (tick - self._tick) * self.context.tick_s
        self._tick = tick
        servo = self.below.message
        self._orders.take_commands(self.operator)
        serials = list_serials(self.above.message)
        self._plans.accept_plan(self.plan, serials)
        if servo.error == Error.DISABLED:
            # An arm that is not enabled may be moved by hand, so plan from its sensed position.
            self._displaced = True
            if not self._is_known:
                self._position[:] = servo.position
        if self._tracking.update_status(self.below):
            self._resume_motion(servo, tick)
        self._guard.update_scene(self.world, servo.position, tick)
        if self._tracking.in_step:
            self._run_segment(serials, tick, passed_s)
        elif self._tracking.silent_cycles > self._rules.count_cycles(self.settings.silent):
            self._fault = SegmentFault(
                Error.BELOW, f"no status from below for {self._tracking.silent_cycles} cycles"
            )
        if servo.state == State.ERROR:
            self._fault = SegmentFault(Error(servo.error), servo.reason)
        self._write_set_point(self.command, tick)
        self._write_status(self.status, serials, tick)
        self._answer_operator(self.above.message.operator)

    def _restore_state(self) -> None:
        """Continue from the last status and command, after a restart of the board."""
        last = self.last_status.message
        self.status.held = -1
        if not self.last_status.has_message or not self.last_command.message.id:
            return
        self._is_known = True
        self._interrupted = last.current
        self._progress = last.progress
        self.status.copy_from(last)
        self.command.copy_from(self.last_command.message)

    def _resume_motion(self, servo: ServoStatus, tick: int) -> None:
        """Continue the segment from the position at which the servo holds the arm."""
        work = self._work
        self._displaced |= self._is_known
        if not self._is_known:
            self._is_known = True
            self.command.opening = servo.opening
            self.command.force = self._gripper.force if self._gripper is not None else 0.0
        self._fault = None
        self._straying.reset_count()
        self._position[:] = servo.target
        self._guard.carry_object(self.status.held, tick - SEEN_CYCLES * self.context.every)
        if isinstance(work, PathWork):
            work.begin_near(self._position, work.progress)
            self._displaced = False
        elif work is not None:
            work.restart_wait()

    def _run_segment(self, serials: list[int], tick: int, passed_s: float) -> None:
        """Run one cycle of the current segment: finish, withdraw, begin or advance it.

        Args:
            serials: Segments in the window of the level above.
            tick: Tick of the cycle.
            passed_s: Time since the last cycle.
        """
        hold = self.above.message.hold or self.above.is_lost or self._orders.is_holding
        if self.below.is_new:
            self._finish_segment(self.below.message, tick)
            self._straying.update_status(self.below.message)
        withdrawn = self._withdraw_segment(serials)
        if self._work is None and self._fault is None:
            self._begin_segment(serials, hold)
        work = self._work
        if work is None:
            return
        if self._fault is None:
            self._fault = (
                work.fault or self._plans.find_refusal(work.segment.id) or self._straying.fault
            )
        if isinstance(work, PathWork):
            hold = (
                hold
                or withdrawn
                or self._fault is not None
                or bool(self._straying.description or self._guard.wait_reason)
            )
            plan = self._plans.find_trajectory(work.segment.id, work.s)
            due_s = (tick + (LEAD_CYCLES - 1) * self.context.every) * self.context.tick_s
            speed_scale = self.context.robot.bring_up if self.below.message.slowed else None
            work.step(hold, plan, self.world.message, due_s, passed_s, speed_scale or 1.0)
            self._position[:] = work.set_point.position

    def _finish_segment(self, servo: ServoStatus, tick: int) -> None:
        """Finish the current segment if the servo shows that it is done."""
        work = self._work
        if work is None or self._fault is not None or not work.check_done(servo):
            return
        if isinstance(work, GripperWork):
            self.status.held = work.held_after
            self._guard.carry_object(work.held_after, tick - SEEN_CYCLES * self.context.every)
        self.status.done = work.segment.id
        self._work = None

    def _withdraw_segment(self, serials: list[int]) -> bool:
        """Drop the current segment and its fault if the segment has left the window.

        Returns:
            True if the motion must come to rest before the segment can be dropped.
        """
        serial = self._work.segment.id if self._work is not None else self._begun
        if serial in serials:
            return False
        if isinstance(self._work, PathWork):
            if not self._work.is_resting:
                return True
            # Messages may arrive out of order, so a withdrawn segment may return and continue.
            self._interrupted = serial
            self._progress = self._work.progress
        self._work = None
        self._fault = None
        return False

    def _begin_segment(self, serials: list[int], hold: bool) -> None:
        """Begin the oldest unfinished segment. During a `hold`, a gripper segment must wait."""
        serial = next((s for s in serials if s > self.status.done), 0)
        if not serial:
            return
        self._begun = serial
        try:
            segment = read_segment(self.above.message, serial)
            if hold and segment.kind is SegmentKind.GRIPPER:
                return
            if segment.kind is SegmentKind.PATH:
                self._work = self._begin_path(segment)
            elif self._gripper is None:
                raise ValueError(f"segment {serial}: the arm has no gripper; valid: paths")
            else:
                self.command.opening = segment.opening
                self.command.force = segment.force
                self._work = GripperWork(segment, self._gripper, self._rules)
        except ValueError as error:
            self._fault = SegmentFault(Error.LIMIT, str(error))
        self._interrupted = 0

    def _begin_path(self, segment: MotionSegment) -> PathWork:
        """Begin a path segment.

        The motion begins at the start of the path. If the path was interrupted, or the arm may have
        been moved away from its start, the motion begins at the point of the path nearest to the
        arm.
        """
        path = segment.build_path()
        self._guard.watch_path(segment, path, self.below.message.opening, self.world.message)
        work = PathWork(segment, path, self._guard, self._rules)
        if segment.id == self._interrupted:
            work.begin_near(self._position, self._progress)
        elif self._displaced:
            work.begin_near(self._position, 0.0)
        else:
            work.begin_at(self._position)
        self._displaced = False
        return work

    def _find_wanted_trajectory(self, serials: list[int]) -> tuple[int, float]:
        """Find the first segment that still needs a trajectory.

        Returns:
            Serial of the segment, or 0 for none, and the path parameter, rad, at which its
            trajectory must begin.
        """
        work = self._work
        kinds = self.above.message.segments["kind"].tolist()
        for serial, kind in zip(serials, kinds, strict=False):
            begin = 0.0 if kind == SegmentKind.PATH else None
            if work is not None and serial == work.segment.id:
                begin = work.wanted_begin if isinstance(work, PathWork) else None
            if (
                serial > self.status.done
                and begin is not None
                and not self._plans.find_trajectory(serial, begin)
                and not self._plans.find_refusal(serial)
            ):
                return serial, begin
        return 0, 0.0

    def _write_set_point(self, command: JointCommand, tick: int) -> None:
        """Write the set point. `due` is 0 while the servo is out of step and must not follow it."""
        work = self._work
        in_step = self._tracking.in_step
        command.id = tick // self.context.every + 1 if self._is_known else 0
        # While out of step, the position of the arm is uncertain, and a set point could be wrong.
        command.due = tick + LEAD_CYCLES * self.context.every if in_step else 0
        set_point = work.set_point if in_step and isinstance(work, PathWork) else self._rest
        command.position[:] = self._position
        command.velocity[:] = set_point.velocity
        command.acceleration[:] = set_point.acceleration
        if self._is_known:
            command.held = self.status.held

    def _write_status(self, status: PrimitiveStatus, serials: list[int], tick: int) -> None:
        """Fill the status: state, current segment and the trajectory requested from the planner."""
        work = self._work
        status.echo = self.above.message.id
        status.state = self._find_state(serials)
        reason = self._find_wait_reason() if status.state == State.EXECUTING else ""
        if reason:
            status.state = State.HOLDING
        status.error, status.reason, status.earliest = self._fault or (0, reason, 0.0)
        interrupted = self._interrupted if self._interrupted in serials else 0
        status.current = work.segment.id if work is not None else interrupted
        servo = self.below.message
        if self.below.has_message:
            status.opening = servo.opening
        status.position[:] = self._position
        status.progress = self._progress * bool(interrupted)
        status.operated = (
            self._orders.is_in_force or servo.standing > 0 or servo.error == Error.DISABLED
        )
        status.blocked = False
        status.resting = True
        status.ends = 0.0
        if isinstance(work, PathWork):
            status.progress = work.progress
            # If the servo is out of step, that is the reason for the hold, not an obstacle.
            status.blocked = work.blocked and self._tracking.in_step
            status.resting = work.is_resting
            due_tick = tick + LEAD_CYCLES * self.context.every
            status.ends = work.compute_end_s(due_tick * self.context.tick_s)
        status.wants, status.begin = self._find_wanted_trajectory(serials)

    def _find_wait_reason(self) -> str:
        """Return why the level waits and what ends the wait. Empty if it does not wait."""
        work = self._work
        command = self.above
        if not self._tracking.in_step:
            return self._tracking.describe_wait(self.below.message)
        if isinstance(work, GripperWork):
            return ""
        if self._orders.is_in_force:
            return self._orders.format_reason(self.context.board)
        if work is not None:
            blocked = f"blocked: {work.obstacle}" if work.blocked else ""
            if reason := self._straying.description or blocked or self._guard.wait_reason:
                return reason
        if command.is_lost:
            return ABOVE_LOST
        if command.message.hold:
            return HELD_FROM_ABOVE
        if work is not None and work.unplanned_cycles > MAX_UNEXPLAINED_CYCLES:
            return f"segment {work.segment.id} waits for its trajectory from the planner"
        return ""

    def _answer_operator(self, above: int) -> None:
        """Report the operator's commands, and pass down the serial of the newest one in effect.

        Args:
            above: Serial of the operator's command on which the command from above is based.
        """
        if self.status.resting:
            self._orders.report_done()
        self.command.operator = self._orders.find_basis(above)
        self._orders.fill_status(self.status, above)

    def _find_state(self, serials: list[int]) -> State:
        """Return the state of the segments. `_write_status` reports HOLDING during a wait."""
        if self._fault is not None:
            return State.ERROR
        if self._work is not None or any(serial > self.status.done for serial in serials):
            return State.EXECUTING
        return State.DONE if serials else State.IDLE
