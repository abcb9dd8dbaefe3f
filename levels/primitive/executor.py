"""The executor of the primitive level: a joint set point every cycle, from paths that its planner has timed."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message, State
from rack.levels.level import Executor, Input, LevelContext, Ports
from rack.levels.messages import (
    JOINT_SET_POINT,
    MOVE_COMMAND,
    PRIMITIVE_STATUS,
    SERVO_STATUS,
    TRAJECTORY,
    WORLD_MODEL,
    Error,
    SegmentKind,
)
from rack.levels.operator import ABOVE_LOST, HELD_FROM_ABOVE, OPERATOR_COMMAND, Operation, Orders
from rack.levels.primitive.fault import Fault
from rack.levels.primitive.gripper_work import GripperWork
from rack.levels.primitive.guard import Guard
from rack.levels.primitive.memory import Memory, recall
from rack.levels.primitive.params import PrimitiveParams
from rack.levels.primitive.path_motion import SetPoint
from rack.levels.primitive.path_work import PathWork, WorkRules
from rack.levels.primitive.plans import Plans
from rack.levels.primitive.segment import Segment, read_segment, window
from rack.levels.primitive.sight import Sight
from rack.levels.primitive.tracking import Straying, Tracking, awaited
from rack.levels.robot.cell import build_cell
from rack.levels.tables import read_params

Work = PathWork | GripperWork

SEEN_CYCLES = 2
"""Cycles by which the world model lags behind the servo: what rests now is seen at rest since then."""
DELAY_CYCLES = 3
"""Cycles from the sensing of the world model to the set point commanded last: what moves has gone on meanwhile."""


class PrimitiveExecutor(Executor):
    """Does the segments of the window, oldest first; each from rest to rest, the next one planned meanwhile.

    Released at tick T it writes the set point due two cycles later: the first brings it to the servo, over the second
    the servo interpolates to it. What it must not forget when its board dies it finds in its own last messages. While
    the board above is lost it rests on its path, as with `hold` from above or of an operator; while the servo does not
    follow it waits.
    """

    inputs = {
        "command": Input(MOVE_COMMAND, "above.command"),
        "status": Input(SERVO_STATUS, "below.status"),
        "plan": Input(TRAJECTORY, "own.plan"),
        "world": Input(WORLD_MODEL, "world.model"),
        "last_command": Input(JOINT_SET_POINT, "own.command"),
        "last_status": Input(PRIMITIVE_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"command": JOINT_SET_POINT, "status": PRIMITIVE_STATUS}
    commands = {Operation.HOLD: (), Operation.RESUME: ()}
    params = PrimitiveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(PrimitiveParams, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._rules = WorkRules(context.robot.joints, cell.limits, self._params, context.period_s)
        self._guard = Guard(cell, context.scene, self._params.lookahead, DELAY_CYCLES * context.period_s)
        self._gripper = context.robot.gripper
        self._sight = Sight(self._guard, round(self._params.blind / context.tick_s), bool(context.scene.bodies))
        self._tracking = Tracking()
        straying = self._rules.cycles(self._params.straying)
        self._straying = Straying(context.robot.joints, self._params.following, straying)
        self._plans = Plans()
        self._orders = Orders(self.commands)
        self._memory: Memory | None = None
        self._work: Work | None = None
        self._fault: Fault | None = None
        self._faulty = 0
        self._position = cell.home.copy()
        self._rest = SetPoint(self._position, *np.zeros((2, len(cell.home))))
        self._tick: int | None = None
        # True when the servo has been away since the last path: the arm may not be where that ended.
        self._displaced = False

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Sample command, status, plan and world model; write the next set point and this level's status."""
        if self._tick is None:
            self._tick, self._memory = tick - self.context.every, recall(read)
        passed_s = (tick - self._tick) * self.context.tick_s
        self._tick = tick
        self._orders.take(read.operator)
        serials = window(read.command.value)
        self._plans.accept(read.plan, serials)
        if self._tracking.update(read.status):
            self._take_up(read, tick)
        self._sight.update(read.world, read.status.value.position, tick)
        if self._tracking.in_step:
            self._go_on(read, serials, tick, passed_s)
        elif read.status.value.state == State.ERROR:
            self._fault = Fault(Error(read.status.value.error), read.status.value.reason)
        elif self._tracking.silent_cycles > self._rules.cycles(self._params.silent):
            self._fault = Fault(Error.BELOW, f"no status from below for {self._tracking.silent_cycles} cycles")
        if read.status.is_there and read.status.value.state == State.ERROR:
            self._fault = Fault(Error(read.status.value.error), read.status.value.reason)
        self._write_set_point(write.command, tick)
        self._write_status(read, write.status, serials, tick)
        self._answer(write, read.command.value.operator)

    def _take_up(self, read: Ports, tick: int) -> None:
        """Go on from where the servo holds the arm."""
        servo, work = read.status.value, self._work
        self._displaced = self._memory is not None
        if self._memory is None:
            force = self._gripper.force if self._gripper is not None else 0.0
            self._memory = Memory(opening=servo.opening, force=force)
        self._fault = None
        self._straying.forget()
        self._position[:] = servo.target
        self._sight.carry(self._memory.held, tick - SEEN_CYCLES * self.context.every)
        if isinstance(work, PathWork):
            work.begin_near(self._position, work.progress)
            self._displaced = False
        elif work is not None:
            work.begin()

    def _go_on(self, read: Ports, serials: list[int], tick: int, passed_s: float) -> None:
        """Do one cycle of the work: finish it, drop it, begin it, step it."""
        hold = bool(read.command.value.hold) or read.command.is_lost or self._orders.standing is Operation.HOLD
        if read.status.is_new:
            self._finish(read.status.value, tick)
            self._straying.update(read.status.value)
        withdrawn = self._withdraw(serials)
        if self._work is None and self._fault is None:
            self._begin(read, serials, hold)
        work = self._work
        if work is None:
            return
        if self._fault is None:
            self._fault = work.fault or self._plans.refusal(work.segment.id) or self._straying.fault
        if isinstance(work, PathWork):
            hold = hold or withdrawn or self._fault is not None or self._straying.strays or bool(self._sight.lacks)
            plan = self._plans.trajectory(work.segment.id, work.motion.s)
            due_s = (tick + self.context.every) * self.context.tick_s
            work.step(hold, plan, read.world.value, due_s, passed_s)
            self._position[:] = work.motion.set_point.position

    def _finish(self, servo: Message, tick: int) -> None:
        work, memory = self._work, self._memory
        if work is None or memory is None or self._fault is not None or not work.done(servo):
            return
        if isinstance(work, GripperWork):
            memory.held = work.held_after
            self._sight.carry(memory.held, tick - SEEN_CYCLES * self.context.every)
        memory.done, self._work = work.segment.id, None

    def _withdraw(self, serials: list[int]) -> bool:
        """Drop work and fault that are no longer in the window; say whether the work must come to rest first."""
        serial = self._work.segment.id if self._work is not None else self._faulty
        if serial in serials:
            return False
        if isinstance(self._work, PathWork) and not self._work.motion.resting:
            return True
        if isinstance(self._work, PathWork) and self._memory is not None:
            # Messages may come out of order: what is withdrawn may be wanted again, and goes on then.
            self._memory.interrupted, self._memory.progress = serial, self._work.progress
        self._work, self._fault = None, None
        return False

    def _begin(self, read: Ports, serials: list[int], hold: bool) -> None:
        """Begin the oldest segment that is not done; with `hold`, the gripper waits."""
        memory = self._memory
        serial = next((s for s in serials if memory is not None and s > memory.done), 0)
        if not serial or memory is None:
            return
        self._faulty = serial
        try:
            segment = read_segment(read.command.value, serial)
            if hold and segment.kind is SegmentKind.GRIPPER:
                return
            begin = self._begin_path if segment.kind is SegmentKind.PATH else self._begin_gripper
            self._work = begin(segment, memory, read)
        except ValueError as error:
            self._fault = Fault(Error.LIMIT, str(error))
        memory.interrupted = 0

    def _begin_gripper(self, segment: Segment, memory: Memory, read: Ports) -> GripperWork:
        if self._gripper is None:
            raise ValueError(f"segment {segment.id}: the arm has no gripper; only paths are valid")
        memory.opening, memory.force = segment.opening, segment.force
        return GripperWork(segment, self._gripper, self._rules)

    def _begin_path(self, segment: Segment, memory: Memory, read: Ports) -> PathWork:
        path = segment.path()
        self._guard.watch(segment, path, read.status.value.opening, read.world.value)
        work = PathWork(segment, path, self._guard, self._rules)
        if segment.id == memory.interrupted:
            work.begin_near(self._position, memory.progress)
        elif self._displaced:
            work.begin_near(self._position, 0.0)
        else:
            work.begin_at(self._position)
        self._displaced = False
        return work

    def _wanted(self, read: Ports, serials: list[int]) -> tuple[int, float]:
        """Return the segment that a trajectory is wanted for, and where on its path it is to begin; 0: none."""
        work, done = self._work, self._memory.done if self._memory is not None else 0
        kinds = read.command.value.segments["kind"].tolist()
        for serial, kind in zip(serials, kinds, strict=False):
            begin = 0.0 if kind == SegmentKind.PATH else None
            if work is not None and serial == work.segment.id:
                begin = work.begin_wanted if isinstance(work, PathWork) else None
            if serial > done and begin is not None and self._plans.lacks(serial, begin):
                return serial, begin
        return 0, 0.0

    def _write_set_point(self, command: Message, tick: int) -> None:
        every, work, memory = self.context.every, self._work, self._memory
        command.id = tick // every + 1 if memory is not None else 0
        # Out of step, no set point is better than one from where the arm may not be.
        command.due = tick + 2 * every if self._tracking.in_step else 0
        command.position[:] = self._position
        moving = work if self._tracking.in_step and isinstance(work, PathWork) else None
        _, velocity, acceleration = moving.motion.set_point if moving is not None else self._rest
        command.velocity[:], command.acceleration[:] = velocity, acceleration
        if memory is not None:
            command.opening, command.force = memory.opening, memory.force
            command.held = memory.held if memory.held is not None else -1

    def _write_status(self, read: Ports, status: Message, serials: list[int], tick: int) -> None:
        work, memory, fault = self._work, self._memory or Memory(), self._fault
        status.echo = read.command.value.id
        status.state = self._state(serials, memory)
        kept_from = self._kept_from(read) if status.state == State.EXECUTING else ""
        if kept_from:
            status.state = State.HOLDING
        status.error, status.reason, status.earliest = fault or (0, kept_from, 0.0)
        status.done, status.held = memory.done, memory.held if memory.held is not None else -1
        interrupted = memory.interrupted if memory.interrupted in serials else 0
        status.current = work.segment.id if work is not None else interrupted
        if read.status.is_there:
            status.opening = read.status.value.opening
        status.position[:] = self._position
        path_work = work if isinstance(work, PathWork) else None
        status.progress = path_work.progress if path_work is not None else memory.progress * bool(interrupted)
        status.operated = self._orders.standing is not Operation.NONE or read.status.value.standing > 0
        # Out of step it is not for the world that motion holds.
        status.blocked = path_work is not None and path_work.blocked and self._tracking.in_step
        status.resting = path_work is None or path_work.motion.resting
        status.ends = path_work.ends_s((tick + 2 * self.context.every) * self.context.tick_s) if path_work else 0.0
        status.wants, status.begin = self._wanted(read, serials)

    def _kept_from(self, read: Ports) -> str:
        """Return who or what keeps the level from its work, and what ends that; empty: nothing does."""
        work, command = self._work, read.command
        if not self._tracking.in_step:
            return awaited(read.status.value, self._tracking.silent_cycles)
        if isinstance(work, GripperWork):
            return ""
        if self._orders.standing is not Operation.NONE:
            return self._orders.keeps(self.context.board)
        if work is not None:
            blocked = f"blocked: {work.obstacle}" if work.blocked else ""
            if reason := self._straying.place or blocked or self._sight.lacks:
                return reason
        if command.is_lost:
            return ABOVE_LOST
        return HELD_FROM_ABOVE if command.value.hold else ""

    def _answer(self, write: Ports, above: int) -> None:
        """Answer the operator, and hand down what this cycle rests on."""
        if write.status.resting:
            self._orders.done()
        write.command.operator = self._orders.rests_on(above)
        self._orders.report(write.status, above)

    def _state(self, serials: list[int], memory: Memory) -> State:
        if self._fault is not None:
            return State.ERROR
        if self._work is not None or any(serial > memory.done for serial in serials):
            return State.EXECUTING
        return State.DONE if serials else State.IDLE
