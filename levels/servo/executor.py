"""The executor of the servo level: in every cycle torques for the arm, or a stop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message, State
from rack.levels.algebra import Array
from rack.levels.arm import Arm, FaultyLink, Link, Sensed, find_arm, preload
from rack.levels.arm.faulty import STEPS
from rack.levels.compiled import compiled
from rack.levels.level import Demand, Executor, Fault, Finding, Input, LevelContext, Output, Ports, Reading, Verdict
from rack.levels.messages import ARM_STATE, JOINT_SET_POINT, SCENE, SERVO_PLAN, SERVO_STATUS, Error
from rack.levels.operator import OPERATOR_COMMAND, Goal, Operation
from rack.levels.robot.cell import build_cell
from rack.levels.servo import actuator_monitor, control, reference, sensor_monitor
from rack.levels.servo.actuator_monitor import ActuatorMonitor
from rack.levels.servo.control import ComputedTorque, Grip, ServoParams
from rack.levels.servo.curves import Motion
from rack.levels.servo.operator_control import OperatorControl
from rack.levels.servo.reference import Reference
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import BrakeLog, Reaction, Stopping
from rack.levels.tables import read_params

SCENES = Output(SCENE, cycles=8)
"""At 400 Hz, a scene for every cycle of the levels that read it."""


class SteadyStatus(NamedTuple):
    """The fields of a status that seldom change."""

    command: int
    holding: bool
    stopped: bool
    braked: bool
    demand: Demand
    clipped: int
    touches: int
    violations: int
    pushed: int
    kept: str  # why the arm does not follow its set points
    error: Error  # latched
    fault: str  # of the arm


class ServoExecutor(Executor):
    """Follows joint set points with torques, and advances the arm's time.

    A cycle first advances the arm by the ticks since the last one: its time is the clock's, even if cycles were missed.
    Safety comes first: on a demand, and while sensors or motors are at fault, the arm holds, stops or is braked;
    afterwards motion resumes from where it is. An operator's command comes second, the level above third.
    """

    inputs = {
        "command": Input(JOINT_SET_POINT, "above.command"),
        "plan": Input(SERVO_PLAN, "own.plan"),
        "before": Input(ARM_STATE, "own.state"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"status": SERVO_STATUS, "state": ARM_STATE, "scene": SCENES}
    faults = STEPS
    commands = {Operation.HOLD: (), Operation.RESUME: (), Operation.SETPOINT: (Goal.JOINTS,)}
    params = ServoParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params, every = read_params(ServoParams, context.params), context.every
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self.arm: Arm = find_arm(params.arm)(cell, context.scene, context.clock_ns, every, context.seed)
        self._faulty = FaultyLink(self.arm, cell, every, self.acted)
        self._link: Link = self.arm  # the path to the arm; through `_faulty` while faults are injected
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)  # set points, interpolated
        self._loop = ComputedTorque(cell, params, self.arm.dynamics)
        self.sensors = SensorMonitor(cell, params, context.tick_s, every)
        self.motors = ActuatorMonitor(cell, params.following, context.period_s)
        self.stopping = Stopping(params, context.robot.joints, context.tick_s, every)
        self.sensors.findings = self.stopping.findings = self.findings  # one list, in order of time
        self.operator = OperatorControl(self.commands, context.robot.joints, cell.limits.position)
        self._brakes = BrakeLog(self.arm, every)
        self._grip = None if context.robot.gripper is None else Grip(context.robot.gripper)
        self._wanted = np.zeros((2, len(cell.home)))  # the motion wanted in the last cycle begins with: rad, rad/s
        self._wanted[0] = cell.home
        self._numbers: tuple[Array, Array, Array] | None = None  # set in every cycle: the first arguments of `show`
        self._show_numbers = show.load()
        self._command = self._rests_on = 0  # serials of the newest command, and of the operator's that it rests on
        self._shown: SteadyStatus | None = None  # in the last status
        self._started = False  # the first cycle has begun
        self._abandoned = False  # set points were abandoned in the last cycle: the arm was braked

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level and of its arm."""
        preload()
        for module in (control, reference, sensor_monitor, actuator_monitor):
            module.preload()
        joints = np.zeros((3, 1))
        show.load()(np.zeros(8), joints[0], joints[0], joints, joints, joints[0], 0.0, 0.0, 0.0)

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the faults between this level and the arm."""
        self._faulty.inject(faults)
        self._link = self._faulty if faults else self.arm

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Advance the arm to `tick`, sense, interpolate, drive, report."""
        missed = self._catch_up(read.before, tick)
        self._take_messages(read)
        sensed, sensors = self._link.sense(), self.sensors
        contact = self.arm.contact
        sensors.look(sensed, tick, None if missed or self._abandoned else self._wanted, contact is not None)
        if contact is not None:
            self.stopping.struck(contact, self.arm.named(contact), tick)
        reaction = self.stopping.decide(self.demand, sensors, tick)
        if reaction is Reaction.BRAKE:
            self._brake()
        elif sensors.fresh:
            self._drive(sensed, reaction, missed, tick)
        else:
            self.motors.drop()  # without a new sample the arm keeps its last torque
        self._brakes.after_cycle(tick, self.findings)
        self._report(write, sensed, reaction)
        self.operator.orders.report(write.status, self._rests_on)
        self.arm.save(write.state)
        self.stopping.remember(write.state)
        if SCENES.is_due(tick, self.context.every, self.context.phase):
            self.arm.look(write.scene)

    def _take_messages(self, read: Ports) -> None:
        """Take over what is new."""
        if read.operator.verdict is Verdict.NEW:
            self.operator.take(read.operator)
        if read.plan.verdict is Verdict.NEW:
            self._loop.take(read.plan.value)
        if read.command.verdict is Verdict.NEW:
            command: Message = read.command.value
            self._command, self._rests_on = command.id, command.operator
            self.reference.take(command)
            if self._grip is not None:
                self._grip.take(command)

    def _catch_up(self, before: Reading, tick: int) -> bool:
        """Advance the arm to `tick`; return whether cycles were missed. A restarted board first restores the arm."""
        if not self._started:
            self._start(before.value if before.is_there else None, tick)
            return False
        ticks = tick - self.arm.tick
        self.arm.step(ticks)
        self._brakes.after_waiting(tick, self.findings)
        if ticks == self.context.every:
            return False
        self.motors.drop()
        return True

    def _start(self, before: Message | None, tick: int) -> None:
        if before is not None:
            self.arm.restore(before)
            self.sensors.recall(before)
            self.stopping.recall(before)
            if self._grip is not None:
                self._grip.keep(self.arm.grip_force)
        if self.arm.braked:
            self._brakes.start(self.arm.tick)
        self.arm.step(tick - self.arm.tick)
        self._brakes.after_waiting(tick, self.findings)
        self._started = self._abandoned = True

    def _brake(self) -> None:
        """Brake, and abandon the set points."""
        self.arm.brake()
        self.motors.drop()
        self._wanted = self.sensors.state
        self._abandoned = True

    def _drive(self, sensed: Sensed, reaction: Reaction, missed: bool, tick: int) -> None:
        """Do one cycle with torques; brake when a motor fails, a torque is refused or a stop is complete."""
        sensors, loop = self.sensors, self._loop
        wanted = self._next_motion(reaction, missed, tick)
        terms = loop.terms(sensors.position, sensors.velocity)
        failed = self.motors.look(wanted.table, sensors.state, terms, loop.holds)
        if failed is not None and self._motor_fails(failed, tick) is Reaction.BRAKE:
            return self._brake()
        if reaction is Reaction.STOP and (self._abandoned or not wanted.velocity.any()):
            return self._brake()
        torque = loop.torque(wanted, sensors.state, terms)
        grip_force = 0.0 if self._grip is None else self._grip.force(sensed.opening, sensed.opening_velocity)
        refused = self._link.drive(torque, grip_force)
        if refused is not None:
            return self._refuse(refused, tick)
        self._wanted, self._abandoned, self.stopping.refused = wanted.table, False, None
        return self.motors.begin()

    def _next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion:
        """Return the wanted motion; after braking it begins where the arm is."""
        sensors, reference = self.sensors, self.reference
        if self._abandoned:
            reference.start(sensors.position, sensors.velocity, tick)
        elif missed:
            reference.meet(sensors.position, sensors.velocity, tick)
        if reaction:
            return reference.rest(tick)
        return self.operator.wanted(reference, tick) if self.operator.stands else reference.at(tick)

    def _motor_fails(self, finding: Finding, tick: int) -> Reaction:
        if not self.stopping.trying:
            self.findings.append(finding)
        return self.stopping.motor_fails(finding.subject, finding.value, tick)

    def _refuse(self, finding: Finding, tick: int) -> None:
        """React to a torque that the arm refused, engaging its brakes."""
        refused = self.stopping.refused
        if refused is None or finding.alarm is not refused.alarm:
            self.findings.append(finding)
        self.stopping.refuse(finding, tick)
        self._brake()

    def _report(self, write: Ports, sensed: Sensed, reaction: Reaction) -> None:
        """Fill the status, and the estimate in the state; the steady fields only when they change."""
        arm, status = self.arm, write.status
        if self._numbers is None:
            moving, kept = numbers(status, "position", "grip_force"), numbers(write.state, "position", "doubt")
            self._numbers = moving, kept, self.motors.torque
        _, _, opening, opening_velocity, _ = sensed
        self._show_numbers(
            *self._numbers, self.sensors.estimate, self._wanted, arm.torque, opening, opening_velocity, arm.grip_force
        )
        shown = (
            self._command,
            self._abandoned or self.reference.holding,
            self._abandoned or reaction > 0 or self.operator.stands,
            arm.braked,
            self.demand,
            arm.clipped + self.reference.refused + self._loop.cut,
            arm.touches,
            arm.violations,
            arm.pushed,
            self.stopping.reason or (self.operator.reason if self.operator.stands else ""),
            self.stopping.error,
            arm.fault,
        )
        if shown != self._shown:
            self._shown = SteadyStatus(*shown)
            self._show(status, self._shown)

    def _show(self, status: Message, shown: SteadyStatus) -> None:
        """Fill the steady fields."""
        status.echo, status.holding, status.stopped, status.braked = shown[:4]
        status.demand, status.clipped, status.touches, status.violations, status.pushed = shown[4:9]
        if shown.fault:
            status.state, status.error, status.reason = State.ERROR, Error.SIMULATION, shown.fault
        elif shown.error:
            status.state, status.error, status.reason = State.ERROR, shown.error, shown.kept
        else:
            resting = State.IDLE if shown.holding else State.EXECUTING
            status.state = State.HOLDING if shown.kept and shown.command else resting
            status.error = Error.LIMIT if shown.violations else Error.TOUCHED if shown.touches else Error.NONE
            status.reason = shown.kept or (self.arm.first_violation if shown.violations else self.arm.first_touch)


def numbers(message: Message, first: str, last: str) -> Array:
    """Return a view of the fields from `first` to `last`, which are adjacent numbers, as one array."""
    fields = message.record.dtype.fields
    assert fields is not None
    begin, end = fields[first][1], fields[last][1] + fields[last][0].itemsize
    return np.frombuffer(message.raw[begin:end])


@compiled
def show(
    status: Array,  # (5 joints + 3,): set, its fields from `position` to `grip_force`
    state: Array,  # (3 joints,): set, its fields from `position` to `doubt`
    begun: Array,  # (joints,), N m: set, see `ActuatorMonitor.torque`
    estimate: Array,  # (3, joints), rad, rad/s, rad
    wanted: Array,  # (2, joints) or more, rad, rad/s
    torque: Array,  # (joints,), N m
    opening: float,  # m
    opening_velocity: float,  # m/s
    grip_force: float,  # N
) -> None:
    """Fill the fields of status and state that change in every cycle."""
    joints = len(torque)
    for j in range(joints):
        for row in range(3):
            state[row * joints + j] = estimate[row, j]
        for row in range(2):
            status[row * joints + j], status[(3 + row) * joints + j] = estimate[row, j], wanted[row, j]
        status[2 * joints + j] = begun[j] = torque[j]
    status[-3], status[-2], status[-1] = opening, opening_velocity, grip_force
