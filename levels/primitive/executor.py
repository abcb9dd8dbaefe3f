"""The executor of the primitive level: a joint set point every cycle, from paths that its planner has timed."""

from __future__ import annotations

import numpy as np

from backplane.message import Message, State
from levels.cell import build_cell
from levels.level import Executor, Input, LevelContext, Ports
from levels.messages import (
    JOINT_SET_POINT,
    MOVE_COMMAND,
    PRIMITIVE_STATUS,
    SERVO_STATUS,
    TRAJECTORY,
    WORLD_MODEL,
    Error,
    SegmentKind,
)
from levels.params import read_params
from levels.primitive.fault import Fault
from levels.primitive.gripper_work import GripperWork
from levels.primitive.guard import Guard
from levels.primitive.memory import Memory, recall
from levels.primitive.params import PrimitiveParams
from levels.primitive.path_motion import SetPoint
from levels.primitive.path_work import PathWork, WorkRules
from levels.primitive.plans import Plans
from levels.primitive.segment import Segment, read_segment, window
from levels.primitive.tracking import Tracking

Work = PathWork | GripperWork

DELAY_CYCLES = 3
"""Cycles from the sensing of the world model to the set point commanded last: what moves has gone on meanwhile."""


class PrimitiveExecutor(Executor):
    """Does the segments of the window, oldest first; each from rest to rest, the next one planned meanwhile.

    Released at tick T it writes the set point due two cycles later: the first brings it to the servo, over the second
    the servo interpolates to it. What it must not forget when its board dies it finds in its own last messages.
    """

    inputs = {
        "command": Input(MOVE_COMMAND, "above.command"),
        "status": Input(SERVO_STATUS, "below.status"),
        "plan": Input(TRAJECTORY, "own.plan"),
        "world": Input(WORLD_MODEL, "world.model"),
        "last_command": Input(JOINT_SET_POINT, "own.command"),
        "last_status": Input(PRIMITIVE_STATUS, "own.status"),
    }
    outputs = {"command": JOINT_SET_POINT, "status": PRIMITIVE_STATUS}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(PrimitiveParams, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._rules = WorkRules(context.robot.joints, cell.limits, self._params, context.period_s)
        self._guard = Guard(cell, context.scene, self._params.lookahead, DELAY_CYCLES * context.period_s)
        self._gripper = context.robot.gripper
        self._tracking = Tracking()
        self._plans = Plans()
        self._memory: Memory | None = None
        self._work: Work | None = None
        self._fault: Fault | None = None
        self._faulty = 0
        self._position = cell.home.copy()
        self._rest = SetPoint(self._position, *np.zeros((2, len(cell.home))))
        self._blind_cycles = 0
        self._tick: int | None = None

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Sample command, status, plan and world model; write the next set point and this level's status."""
        if self._tick is None:
            self._tick, self._memory = tick - self.context.every, recall(read)
        passed_s = (tick - self._tick) * self.context.tick_s
        self._tick = tick
        serials = window(read.command.value)
        self._plans.accept(read.plan, serials)
        self._blind_cycles = 0 if read.world.is_new else self._blind_cycles + 1
        if self._tracking.update(read.status):
            self._take_up(read)
        if self._tracking.in_step:
            self._go_on(read, serials, tick, passed_s)
        elif self._tracking.silent_cycles > self._rules.cycles(self._params.silent):
            self._fault = Fault(Error.BELOW, f"no status from below for {self._tracking.silent_cycles} cycles")
        self._write_set_point(write.command, tick)
        self._write_status(read, write.status, serials, tick)

    def _take_up(self, read: Ports) -> None:
        """Go on from where the servo holds the arm."""
        servo = read.status.value
        if self._memory is None:
            force = self._gripper.force if self._gripper is not None else 0.0
            self._memory = Memory(opening=servo.opening, force=force)
        self._fault = None
        self._position[:] = servo.target
        self._guard.carry(self._memory.held, servo.position, read.world.value)
        if isinstance(self._work, PathWork):
            self._work.begin_near(self._position)

    def _go_on(self, read: Ports, serials: list[int], tick: int, passed_s: float) -> None:
        """Do one cycle of the work: finish it, drop it, begin it, step it."""
        self._finish(read)
        withdrawn = self._withdraw(serials)
        if self._work is None and self._fault is None:
            self._begin(read, serials)
        work = self._work
        if work is None:
            return
        if self._fault is None:
            self._fault = work.fault or self._plans.refusal(work.segment.id) or self._straying(read.status.value)
        if isinstance(work, PathWork):
            hold = bool(read.command.value.hold) or withdrawn or self._fault is not None or self._is_blind(read)
            plan = self._plans.trajectory(work.segment.id, work.motion.s)
            due_s = (tick + self.context.every) * self.context.tick_s
            work.step(hold, plan, read.world.value, due_s, passed_s)
            self._position[:] = work.motion.set_point.position

    def _finish(self, read: Ports) -> None:
        work, memory = self._work, self._memory
        if work is None or memory is None or self._fault is not None or not work.done(read.status.value):
            return
        if isinstance(work, GripperWork):
            memory.held = work.held_after
            self._guard.carry(memory.held, read.status.value.position, read.world.value)
        memory.done, self._work = work.segment.id, None

    def _withdraw(self, serials: list[int]) -> bool:
        """Drop work and fault that are no longer in the window; say whether the work must come to rest first."""
        serial = self._work.segment.id if self._work is not None else self._faulty
        if serial in serials:
            return False
        if isinstance(self._work, PathWork) and not self._work.motion.resting:
            return True
        self._work, self._fault = None, None
        return False

    def _begin(self, read: Ports, serials: list[int]) -> None:
        """Begin the oldest segment that is not done."""
        memory = self._memory
        serial = next((s for s in serials if memory is not None and s > memory.done), 0)
        if not serial or memory is None:
            return
        self._faulty = serial
        try:
            segment = read_segment(read.command.value, serial)
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
            work.begin_near(self._position)
        else:
            work.begin_at(self._position)
        return work

    def _straying(self, servo: Message) -> Fault | None:
        away = np.abs(servo.position - servo.target)
        permitted = self._params.following
        if away.max() <= permitted:
            return None
        joint = int(away.argmax())
        name = self.context.robot.joints[joint]
        reason = f"joint '{name}' is {away[joint]:.4f} rad from its set point; at most {permitted} is valid"
        return Fault(Error.FOLLOWING, reason)

    def _is_blind(self, read: Ports) -> bool:
        """Say whether the world model is missing, where there is something to see."""
        stale = self._blind_cycles > self._rules.cycles(self._params.blind)
        return bool(self.context.scene.bodies) and (stale or not read.world.is_there)

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
        status.error, status.reason, status.earliest = fault or (0, "", 0.0)
        status.done, status.held = memory.done, memory.held if memory.held is not None else -1
        status.current = work.segment.id if work is not None else memory.interrupted
        status.opening = read.status.value.opening
        status.position[:] = self._position
        path_work = work if isinstance(work, PathWork) else None
        status.progress = path_work.progress if path_work is not None else 0.0
        status.blocked = path_work is not None and path_work.blocked
        status.resting = path_work is None or path_work.motion.resting
        status.ends = path_work.ends_s((tick + 2 * self.context.every) * self.context.tick_s) if path_work else 0.0
        status.wants, status.begin = self._wanted(read, serials)

    def _state(self, serials: list[int], memory: Memory) -> State:
        if self._fault is not None:
            return State.ERROR
        if self._work is not None or any(serial > memory.done for serial in serials):
            return State.EXECUTING
        return State.DONE if serials else State.IDLE
