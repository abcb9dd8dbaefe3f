"""The part of a level that drives an arm, whatever it drives it to: sense, decide, drive or brake,
report.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from rack.backplane.message import Message, State
from rack.backplane.watch.alarms import BY_DEMAND, Alarm
from rack.levels import compiled
from rack.levels.algebra import Array
from rack.levels.arm import DrivableArm, DriveState, Sensed, find_arm, preload
from rack.levels.arm.drivable import Link
from rack.levels.fault_steps import ARM_STEPS
from rack.levels.level import (
    Executor,
    Fault,
    Finding,
    LevelContext,
    Misfits,
    Output,
    Reading,
)
from rack.levels.messages import ArmState, DrivenArm, Error, Scene
from rack.levels.operator import Operation, OperatorCommand, Orders
from rack.levels.robot.cell import cell_of, sensed_by
from rack.levels.robot.dynamics import Payload, Terms
from rack.levels.servo import actuator_monitor, sensor_monitor
from rack.levels.servo.actuator_monitor import ActuatorMonitor
from rack.levels.servo.control import ArmParams, SetPointLaw
from rack.levels.servo.curves import Motion
from rack.levels.servo.enabling import Enabling
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import Cause, Reaction, Stopping
from rack.levels.tables import read_params

SCENES = Output(Scene, cycles=8)
"""At 400 Hz, a scene for every cycle of the levels that read it."""


class Course(NamedTuple):
    """What a status says of set points."""

    command: int
    holding: bool
    stopped: bool
    cut: int  # cycles in which the level itself cut a set point or a torque
    kept: str  # why the arm does not follow its set points


class ArmDriver(Executor):
    """Drives an arm and advances its time; subclasses give the motion wanted, and the torques for
    it.

    A cycle first advances the arm by the ticks since the last one: its time is the clock's, even if
    cycles were missed. Safety comes first: on a demand, and while sensors or motors are at fault,
    the arm holds, stops or is braked; afterwards motion resumes from where it is.

    A subclass reads its last state as "before", and writes "status", "state" and "scene".
    """

    faults = ARM_STEPS
    params: ClassVar[type[ArmParams]] = ArmParams
    settings: ArmParams
    gives_set_points: ClassVar[bool] = False
    """Whether it can drive an arm by set points, too: its torques are then those predicted."""
    ahead: SetPointLaw | None = None
    """The set points of a cycle, for drives that take them; None: they take torques."""
    orders: Orders
    """The operator's."""
    before: Reading[ArmState]
    status: DrivenArm
    state: ArmState
    scene: Scene
    terms: Terms
    """The equation of motion in this cycle."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        every = context.every
        robot = context.robot
        kind = find_arm(params.arm)
        cell = sensed_by(cell_of(context), robot, kind.sensors)
        self.cell = cell
        self.arm: DrivableArm = kind(cell, context.scene, context.clock_ns, every, context.seed)
        self.part = robot.bring_up or 1.0  # of full speed, until the operator's release
        self._path = self.arm.connect(context.tick_s, self.part, self.acted, lambda: self.holds)
        self._link: Link = self._path.sound
        self.sensors = SensorMonitor(cell, params, context.tick_s, every)
        is_reported = cell.interface == "torque" or self.arm.reports_torque
        self.motors = ActuatorMonitor(cell, params.following, context.period_s, is_reported)
        self.stopping = Stopping(params, context.robot.joints, context.tick_s, every)
        self.enabling = Enabling(self.arm, context)
        self.sensors.findings = self.stopping.findings = self.findings  # one list, in order of time
        self._wanted = np.zeros(
            (2, len(cell.home))
        )  # the motion wanted in the last cycle begins with: rad, rad/s
        self._wanted[0] = cell.home
        # Views of what changes in every cycle, in status and state.
        self._numbers: tuple[Array, Array, Array] | None = None
        self._shown: tuple[object, ...] = ()  # what seldom changes, in the last status
        self._started = False  # the first cycle has begun
        self._adopted = False  # the arm is enabled, and its pose then was taken over
        self.abandoned = False  # set points were abandoned in the last cycle: the arm was braked
        self.followed = self.rests_on = (
            0  # serials of the newest command, and of the operator's that it rests on
        )

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level and of its arm."""
        super().preload()
        preload()
        compiled.preload(sensor_monitor, actuator_monitor)

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield a hand, whose tendons have a board of another kind, and an arm whose samples are
        too coarse to guard it.
        """
        robot = context.robot
        given = context.params.get("arm")
        if given is not None and not find_arm(given).keeps_limits:
            kind = find_arm(given)
            cell = sensed_by(cell_of(context), robot, kind.sensors)
            if why := kind.misfit(cell, robot.bring_up or 1.0):
                yield "params.arm", given, why
        if robot.hand is not None:
            yield (
                "executor",
                cls.__name__,
                "it drives an arm with motors; [robot.hand] is a hand of tendons",
            )
        interface = context.robot.interface
        reference = read_params(cls.params, context.params).arm
        if interface != "torque" and not cls.gives_set_points:
            why = f'it gives torques; [robot] interface is "{interface}"'
            yield "executor", cls.__name__, why
        elif not find_arm(reference).takes(interface):
            way = "drive" if interface == "torque" else "follow"
            why = f'no `{way}` of the class takes [robot] interface "{interface}"'
            yield "params.arm", reference, why

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the faults between this level and the arm."""
        self._path.faulty.inject(faults)
        self._link = self._path.faulty if faults else self._path.sound

    @abstractmethod
    def take_messages(self) -> None:
        """Take over what is new."""

    @abstractmethod
    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion | None:
        """Return the motion wanted in this cycle; None: there is none, brake. `missed`: cycles
        before it were missed.

        After braking (`abandoned`) it begins where the arm is; with a reaction it comes to rest.
        """

    def find_terms(self) -> Terms:
        """Return the equation of motion at the sensed state, with what the gripper holds."""
        return self.arm.dynamics.terms(self.sensors.position, self.sensors.velocity, self.payload)

    @abstractmethod
    def efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Return torques, (joints,), N m, and grip force, N, for the wanted motion, at the `terms`
        of the cycle.
        """

    @property
    @abstractmethod
    def payload(self) -> Payload | None:
        """What the gripper holds; None: nothing, or not known."""

    @property
    @abstractmethod
    def holds(self) -> bool:
        """Whether the gripper holds a part."""

    @abstractmethod
    def course(self, reaction: Reaction) -> Course:
        """Return what the status says of set points."""

    @property
    def has_work(self) -> bool:
        """Whether the level has work from which it can be kept. Default: once there was a
        command.
        """
        return self.followed > 0

    @property
    def note(self) -> str:
        """What the status says while there is nothing worse to say. Default: nothing."""
        return ""

    def obey(self, command: OperatorCommand) -> str:
        """Obey one of `rack.levels.operator.DRIVES`; return why not, empty: it does."""
        if command.what != Operation.RELEASE:
            return self.enabling.obey(command)
        self.part = 1.0
        self.arm.permit(self.part)
        return ""

    def feel(self, tick: int) -> None:
        """Sense more than the joints, before it is decided whether the arm stops. Default:
        nothing.
        """

    def adopted(self) -> None:
        """React to an arm that has been enabled, wherever it is. Default: nothing."""

    def started(self) -> None:
        """React to the start of a board whose arm was restored from its last state. Default:
        nothing.
        """

    def process(self, tick: int) -> None:
        """Advance the arm to `tick`, sense, drive or brake, report."""
        missed = self._catch_up(self.before, tick)
        self.take_messages()
        sensed = self._link.sense()
        sensors = self.sensors
        contact = self.arm.contact
        if self._is_judged(sensed, tick):
            wanted = None if missed or self.abandoned else self._wanted
            sensors.look(sensed, tick, wanted, contact is not None)
        if contact is not None:
            blow = Cause(Error.TOUCHED, f"unintended contact: {self.arm.named(contact)}")
            self.stopping.stop_for(blow, Finding(Alarm.COLLISION, *contact), tick)
        if self._adopted and self.arm.exceeded is not None:
            finding, text = self.arm.exceeded
            cause = Cause(Error.LIMIT, text, finding.subject, finding.value)
            self.stopping.stop_for(cause, finding, tick)
        self.feel(tick)
        if serial := self.enabling.arrived():
            self.orders.drives_done(serial)
        if self.enabling.is_enabled:
            reaction = self.stopping.decide(self.demand, sensors, tick)
        else:
            error = Error.DRIVES if self.arm.state is DriveState.FAULT else Error.DISABLED
            reaction = self.stopping.wait(error, self.enabling.reason, tick)
        if reaction is Reaction.BRAKE:
            self.brake()
        elif sensors.fresh:
            self._drive(sensed, reaction, missed, tick)
        else:
            self.motors.drop()  # without a new sample the arm keeps its last torque
        self.arm.brake_cause = BY_DEMAND if self.demand else self.stopping.cause
        self._report(sensed, reaction)
        self.orders.report(self.status, self.rests_on)
        self.arm.save(self.state)
        self.stopping.remember(self.state)
        if SCENES.is_due(tick, self.context.every, self.context.phase):
            self.arm.look(self.scene)

    def _catch_up(self, before: Reading[ArmState], tick: int) -> bool:
        """Advance the arm to `tick`; return whether cycles were missed. A restarted board first
        restores the arm.
        """
        if not self._started:
            state = before.message if before.is_there else None
            self._start(state, tick)
            return False
        ticks = tick - self.arm.tick
        self.arm.step(ticks)
        self.arm.report_waiting()
        if ticks == self.context.every:
            return False
        self.motors.drop()
        return True

    def _is_judged(self, sensed: Sensed, tick: int) -> bool:
        """Return whether this sample can be judged: until the arm is enabled, it only says where
        the arm is, and may be missing.
        """
        is_enabled = self.enabling.is_enabled
        if self._adopted and is_enabled:
            return True
        is_adopted = self.sensors.adopt(sensed, tick)
        self._adopted = is_adopted and is_enabled
        if self._adopted:
            self.adopted()
        return is_adopted or is_enabled

    def _start(self, before: ArmState | None, tick: int) -> None:
        self.enabling.start(before is not None)
        if before is not None:
            self.arm.restore(before)
            self.sensors.recall(before)
            self.stopping.recall(before)
            self.started()
            self._adopted = self.enabling.is_enabled
        self.arm.step(tick - self.arm.tick)
        self.arm.report_waiting()
        self._started = self.abandoned = True

    def brake(self) -> None:
        """Brake, and abandon the set points."""
        self.arm.brake()
        self.motors.drop()
        self._wanted = self.sensors.state
        self.abandoned = True

    def _drive(self, sensed: Sensed, reaction: Reaction, missed: bool, tick: int) -> None:
        """Do one cycle with torques; brake when a motor fails, a torque is refused or a stop is
        complete.
        """
        wanted = self.next_motion(reaction, missed, tick)
        if wanted is None:
            return self.brake()
        self.terms = self.find_terms()
        failed = self.motors.look(wanted.table, self.sensors.state, self.terms, self.holds)
        if failed is not None:
            if not self.stopping.trying:
                self.findings.append(failed)
            if self.stopping.motor_fails(failed.subject, failed.value, tick) is Reaction.BRAKE:
                return self.brake()
        if reaction is Reaction.STOP and (self.abandoned or not wanted.velocity.any()):
            return self.brake()
        torque, grip_force = self.efforts(wanted, sensed)
        if self.ahead is None:
            refused = self._link.drive(torque, grip_force)
        else:
            target = self.ahead.target(wanted, self.sensors.position, torque)
            refused = self._link.follow(target, grip_force)
        if refused is not None:
            self.stopping.refuse(refused, tick)  # the arm has engaged its brakes
            return self.brake()
        self._wanted = wanted.table
        self.abandoned = False
        self.stopping.refused = None
        return self.motors.begin()

    def _report(self, sensed: Sensed, reaction: Reaction) -> None:
        """Fill the status, and the estimate in the state; the steady fields only when they
        change.
        """
        arm = self.arm
        status = self.status
        if self._numbers is None:
            self._numbers = (
                numbers(status, "position", "target_velocity").reshape(5, -1),
                numbers(status, "opening", "grip_force"),
                numbers(self.state, "position", "doubt").reshape(3, -1),
            )
        joints, gripper, kept = self._numbers
        kept[:] = self.sensors.estimate
        joints[:2] = self.sensors.state
        joints[2] = self.motors.torque[:] = arm.torque
        joints[3:] = self._wanted[:2]
        gripper[:] = sensed.opening, sensed.opening_velocity, arm.grip_force
        course = self.course(reaction)
        shown = (
            course,
            arm.braked,
            self.demand,
            arm.clipped,
            arm.touches,
            arm.violations,
            arm.pushed,
            self.part,
            self.stopping.error,
            arm.fault,
            self.note,
        )
        if shown != self._shown:
            self._shown = shown
            self._show(status, course)

    def _show(self, status: DrivenArm, course: Course) -> None:
        """Fill the steady fields."""
        arm = self.arm
        stopping = self.stopping
        kept = course.kept
        slowed = self.part < 1.0
        status.echo = course.command
        status.holding = course.holding
        status.stopped = course.stopped
        status.braked = arm.braked
        status.demand = self.demand
        status.clipped = arm.clipped + course.cut
        status.touches = arm.touches
        status.violations = arm.violations
        status.pushed = arm.pushed
        status.slowed = slowed
        status.reason = kept
        if stopping.is_disabled:
            status.state = State.HOLDING
            status.error = stopping.cause
        elif arm.fault:
            status.state = State.ERROR
            status.error = Error.SIMULATION
            status.reason = arm.fault
        elif stopping.error:
            status.state = State.ERROR
            status.error = stopping.error
        else:
            resting = State.IDLE if course.holding else State.EXECUTING
            status.state = State.HOLDING if kept and self.has_work else resting
            touched = Error.TOUCHED if arm.touches else Error.NONE
            status.error = Error.LIMIT if arm.violations else touched
            broken = arm.first_violation if arm.violations else arm.first_touch
            slow = self.enabling.slow if slowed else ""
            status.reason = kept or broken or slow or self.note


def numbers(message: Message, first: str, last: str) -> Array:
    """Return a view of the fields from `first` to `last`, which are adjacent numbers, as one
    array.
    """
    fields = message.record.dtype.fields
    assert fields is not None
    begin = fields[first][1]
    end = fields[last][1] + fields[last][0].itemsize
    return np.frombuffer(message.raw[begin:end])
