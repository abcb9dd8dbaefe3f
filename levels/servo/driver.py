"""The part of a level that drives an arm, whatever motion it is driven to follow.

A cycle has three phases:

1. `ArmDriver._watch` checks what the arm senses, and decides how to react. `Takeover` handles the
   start of the board and arms that are not enabled.
2. `ArmDriver._drive` drives the arm, or `ArmDriver.brake` brakes it.
3. `ArmReport` fills the status and the state.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np

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
from rack.levels.servo.arm_report import ArmReport, SetPointStatus
from rack.levels.servo.control import ArmParams, SetPointLaw
from rack.levels.servo.curves import Motion
from rack.levels.servo.enabling import Enabling, Takeover
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import Cause, Reaction, Stopping
from rack.levels.tables import read_params

SCENES = Output(Scene, cycles=8)
"""At 400 Hz, a scene for every cycle of the levels that read it."""


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
        self.takeover = Takeover(self.arm, self.sensors, self.stopping, self.enabling)
        self.abandoned = True  # set points were abandoned in the last cycle: the arm was braked
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
        reference = read_params(cls.params, context.params).arm
        kind = find_arm(reference)
        if not kind.keeps_limits:
            cell = sensed_by(cell_of(context), robot, kind.sensors)
            if why := kind.misfit(cell, robot.bring_up or 1.0):
                yield "params.arm", reference, why
        if robot.hand is not None:
            yield (
                "executor",
                cls.__name__,
                "it drives an arm with motors; [robot.hand] is a hand of tendons",
            )
        interface = robot.interface
        if interface != "torque" and not cls.gives_set_points:
            why = f'it gives torques; [robot] interface is "{interface}"'
            yield "executor", cls.__name__, why
        elif not kind.takes(interface):
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
    def course(self, reaction: Reaction) -> SetPointStatus:
        """Return what the status says of set points."""

    @cached_property
    def _report(self) -> ArmReport:
        """Report into the messages, which the board places after the constructor has returned."""
        slow = self.enabling.slow
        return ArmReport(self.status, self.state, self.arm, self.sensors, self.stopping, slow)

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
        """Advance the arm to `tick`, sense, drive or brake, and report."""
        missed = self._advance(tick)
        self.take_messages()
        sensed = self._link.sense()
        reaction = self._watch(sensed, missed, tick)
        if reaction is Reaction.BRAKE:
            self.brake()
        elif self.sensors.fresh:
            self._drive(sensed, reaction, missed, tick)
        else:
            self.motors.drop()  # without a new sample the arm keeps its last torque
        self.arm.brake_cause = BY_DEMAND if self.demand else self.stopping.cause
        self.motors.torque[:] = self.arm.torque
        self._report.write_numbers(sensed, self._wanted)
        self._report.write_fields(self.course(reaction), self.demand, self.part)
        self.orders.report(self.status, self.rests_on)
        self.arm.save(self.state)
        self.stopping.remember(self.state)
        if SCENES.is_due(tick, self.context.every, self.context.phase):
            self.arm.look(self.scene)

    def _advance(self, tick: int) -> bool:
        """Advance the arm to `tick`, in the first cycle after taking it over.

        Returns:
            Whether cycles were missed since the last one.
        """
        begins = not self.takeover.is_started
        if begins and self.takeover.start(self.before):
            self.started()
        ticks = tick - self.arm.tick
        self.arm.step(ticks)
        self.arm.report_waiting()
        if begins or ticks == self.context.every:
            return False
        self.motors.drop()
        return True

    def _watch(self, sensed: Sensed, missed: bool, tick: int) -> Reaction:
        """Check the sample, contacts, limits and drives; return the reaction of this cycle."""
        contact = self.arm.contact
        takeover = self.takeover
        was_complete = takeover.is_complete
        if takeover.adopt(sensed, tick):
            wanted = None if missed or self.abandoned else self._wanted
            self.sensors.look(sensed, tick, wanted, contact is not None)
        if takeover.is_complete and not was_complete:
            self.adopted()
        if contact is not None:
            blow = Cause(Error.TOUCHED, f"unintended contact: {self.arm.named(contact)}")
            self.stopping.stop_for(blow, Finding(Alarm.COLLISION, *contact), tick)
        if takeover.is_complete and self.arm.exceeded is not None:
            finding, text = self.arm.exceeded
            cause = Cause(Error.LIMIT, text, finding.subject, finding.value)
            self.stopping.stop_for(cause, finding, tick)
        self.feel(tick)
        if serial := self.enabling.arrived():
            self.orders.drives_done(serial)
        if self.enabling.is_enabled:
            return self.stopping.decide(self.demand, self.sensors, tick)
        error = Error.DRIVES if self.arm.state is DriveState.FAULT else Error.DISABLED
        return self.stopping.wait(error, self.enabling.reason, tick)

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
