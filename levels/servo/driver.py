"""The part of a level that drives an arm, independent of the motion that the arm follows.

A cycle has three phases:

- Check: `ArmDriver._check_arm` checks the samples of the sensors, and decides how to react. Before
  that, `Enabling` takes over the arm at the start of the board and after the drives are enabled.
- Drive: `ArmDriver._drive_arm` drives the arm, or `ArmDriver.brake_arm` brakes it.
- Report: `ArmReport` fills the status and the state.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rack.backplane.message import Message
from rack.backplane.watch.alarms import BRAKED_BY_DEMAND, Alarm
from rack.levels import compiled
from rack.levels.algebra import Array
from rack.levels.arm import DriveState, Sensed, find_arm, preload
from rack.levels.arm.link import Link
from rack.levels.fault_steps import ARM_STEPS
from rack.levels.level import (
    Executor,
    Fault,
    Finding,
    LevelContext,
    Mismatches,
    Output,
    Reading,
)
from rack.levels.messages import ArmState, DrivenArm, Error, Scene
from rack.levels.operator import Operation, OperatorCommand
from rack.levels.robot.cell import build_level_cell, replace_encoders
from rack.levels.robot.dynamics import Payload, Terms
from rack.levels.servo import actuator_monitor, sensor_monitor
from rack.levels.servo.actuator_monitor import ActuatorMonitor
from rack.levels.servo.arm_report import ArmReport, SetPointStatus
from rack.levels.servo.control import ArmParams, SetPointLaw
from rack.levels.servo.curves import Motion
from rack.levels.servo.enabling import Enabling
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import Cause, Reaction, Stopping
from rack.levels.tables import read_params

if TYPE_CHECKING:
    from rack.levels.arm import Arm

SCENES = Output(Scene, cycles=8)
"""A scene in every eighth cycle: at 400 Hz, one for each cycle of the levels that read it."""


class ArmDriver(Executor):
    """Drives an arm and advances its time. Subclasses compute the motion and the torques.

    A cycle first advances the arm by the ticks since the last cycle, so that its time equals the
    clock even if cycles were missed. Safety comes first: while the rack demands a stop, or sensors
    or motors are at fault, the arm holds, stops or is braked. Afterwards motion resumes from the
    position of the arm.

    A subclass declares the input `before`, which reads its own last state, and the outputs
    `status`, `state` and `scene`.

    Attributes:
        followed: Id of the newest command from the level above.
        rests_on: Serial of the operator's command on which that command is based.
        abandoned: True if the arm was braked in the last cycle, so that its set points were
            abandoned.
        speed_scale: Permitted fraction of full speed, up to 1.
    """

    faults = ARM_STEPS
    params: ClassVar[type[ArmParams]] = ArmParams
    settings: ArmParams
    gives_set_points: ClassVar[bool] = False
    """True if the level can also drive an arm by set points. Its torques are then predictions."""
    set_point_law: SetPointLaw | None = None
    """Computes set points for position or velocity drives. None for torque drives."""
    before: Reading[ArmState]
    status: DrivenArm
    state: ArmState
    scene: Scene
    terms: Terms
    """Equation of motion in this cycle."""
    payload: Payload | None = None
    """Payload in the gripper. None if the gripper is empty or the payload is unknown."""
    holds_part = False
    """True if the gripper holds a part."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        every = context.every
        robot = context.robot
        kind = find_arm(params.arm)
        cell = replace_encoders(build_level_cell(context), robot, kind.sensors)
        self.cell = cell
        self.arm: Arm = kind(cell, context.scene, context.clock_ns, every, context.seed)
        self.speed_scale = robot.bring_up or 1.0  # reduced until the operator's release
        self._faulty_link = self.arm.connect(
            context.tick_s, self.speed_scale, self.acted, lambda: self.holds_part
        )
        self._link: Link = self._faulty_link.faultless
        self.sensors = SensorMonitor(cell, params, context.tick_s, every)
        is_reported = cell.interface == "torque" or self.arm.reports_torque
        self.motors = ActuatorMonitor(cell, params.following, context.period_s, is_reported)
        self.stopping = Stopping(params, robot.joints, context.tick_s, every)
        self.enabling = Enabling(self.arm, self.sensors, self.stopping, context)
        # One list keeps the findings in order of time.
        self.sensors.findings = self.stopping.findings = self.findings
        # First rows of the motion wanted in the last cycle: (joints,), rad and rad/s.
        self._wanted = np.zeros((2, len(cell.home)))
        self._wanted[0] = cell.home
        self.abandoned = True
        self.followed = self.rests_on = 0

    @classmethod
    def preload(cls) -> None:
        """Load the compiled functions of the level and of its arm."""
        super().preload()
        preload()
        compiled.preload(sensor_monitor, actuator_monitor)

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield a mismatch if the robot is a hand, or an arm that the level cannot drive or guard.

        A hand with tendons needs a board of another kind. An arm that needs a guard must have
        encoders that are precise enough for it. The arm must accept the torques or set points of
        the level.
        """
        robot = context.robot
        reference = read_params(cls.params, context.params).arm
        kind = find_arm(reference)
        if not kind.keeps_limits:
            cell = replace_encoders(build_level_cell(context), robot, kind.sensors)
            if why := kind.find_connect_error(cell, robot.bring_up or 1.0):
                yield "params.arm", reference, why
        if robot.hand is not None:
            yield (
                "executor",
                cls.__name__,
                "it drives an arm with motors; [robot.hand] is a hand of tendons",
            )
        interface = robot.interface
        if interface != "torque" and not cls.gives_set_points:
            yield "executor", cls.__name__, f'it gives torques; [robot] interface is "{interface}"'
        elif not kind.has_interface(interface):
            method = "drive" if interface == "torque" else "follow"
            text = f'no `{method}` of the class takes [robot] interface "{interface}"'
            yield "params.arm", reference, text

    @classmethod
    def find_standby_obstacle(cls, params: Mapping[str, Any]) -> str:
        """Return why the level cannot have a standby: it drives an arm that is not simulated.

        Two processes can each simulate an arm, but cannot both have a connection to drives.
        """
        reference = params.get("arm", ArmParams.model_fields["arm"].default)
        with suppress(ValueError):
            kind = find_arm(reference)
            if not kind.is_simulated:
                return f"arm {kind.__name__} is not a simulation, and one process must drive it"
        return super().find_standby_obstacle(params)

    def realign(self, state: Message) -> None:
        """Continue the simulation and the estimates from a state of the active copy."""
        assert isinstance(state, ArmState), "the port `state`"
        self.enabling.restore_arm(state)

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the faults that are injected between this level and the arm."""
        self._faulty_link.inject(faults)
        self._link = self._faulty_link if faults else self._faulty_link.faultless

    @abstractmethod
    def take_messages(self) -> None:
        """Process the new messages of this cycle."""

    @abstractmethod
    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion | None:
        """Return the motion wanted in this cycle, or None to brake.

        After braking (`abandoned`) the motion must begin at the position of the arm. If there is a
        reaction, the motion must come to rest.

        Args:
            reaction: Reaction of this cycle, weaker than BRAKE.
            missed: True if cycles before this one were missed.
            tick: Tick of the cycle.
        """

    def find_terms(self) -> Terms:
        """Return the equation of motion at the sensed state, including the payload."""
        return self.arm.dynamics.terms(self.sensors.position, self.sensors.velocity, self.payload)

    @abstractmethod
    def compute_efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Compute the torques and the force of the gripper for the wanted motion.

        Implementations may use `terms`, the equation of motion of this cycle.

        Args:
            wanted: Motion wanted in this cycle.
            sensed: Sample of this cycle.

        Returns:
            Torques, (joints,), N m, and force of the gripper, N.
        """

    @abstractmethod
    def report_set_points(self, reaction: Reaction) -> SetPointStatus:
        """Return the section of the status that reports on the set points."""

    @cached_property
    def _report(self) -> ArmReport:
        """Writer of the status and the state.

        It is created in the first cycle, because the board provides the messages only after the
        constructor has run.
        """
        return ArmReport(
            self.status, self.state, self.arm, self.sensors, self.stopping, self.enabling.slow
        )

    def obey_drive_command(self, command: OperatorCommand) -> str:
        """Carry out one of `rack.levels.operator.DRIVE_OPERATIONS`.

        Returns:
            Reason for the refusal, or an empty string.
        """
        if command.what != Operation.RELEASE:
            return self.enabling.obey_command(command)
        self.speed_scale = 1.0
        self.arm.permit_speed(self.speed_scale)
        return ""

    def sense_contact(self, tick: int) -> None:
        """Read further sensors before the reaction is decided. The default does nothing."""

    def on_adopted(self) -> None:
        """Handle the adoption of a newly enabled arm's pose. The default does nothing."""

    def on_restored(self) -> None:
        """Handle the restoration of the arm after a restart. The default does nothing."""

    def process(self, tick: int) -> None:
        """Run one cycle: advance the arm to `tick`, check it, drive or brake it, and report."""
        missed = self._advance_arm(tick)
        self.take_messages()
        sensed = self._link.sense()
        reaction = self._check_arm(sensed, missed, tick)
        if reaction is Reaction.BRAKE:
            self.brake_arm()
        elif self.sensors.fresh:
            self._drive_arm(sensed, reaction, missed, tick)
        else:
            # Without a new sample the arm keeps its last torque.
            self.motors.drop_cycle()
        self.arm.brake_cause = BRAKED_BY_DEMAND if self.demand else self.stopping.cause
        self.motors.torque[:] = self.arm.torque
        followed = self.report_set_points(reaction)
        self._report.write_cycle(sensed, self._wanted, followed, self.demand, self.speed_scale)
        self._orders.fill_status(self.status, self.rests_on)
        self.arm.save(self.state)
        self.stopping.save_state(self.state)
        if SCENES.is_due(tick, self.context.every, self.context.phase):
            self.arm.look(self.scene)

    def _advance_arm(self, tick: int) -> bool:
        """Advance the arm to `tick`. In the first cycle, take over the arm before that.

        Returns:
            True if cycles were missed since the last one.
        """
        is_first = not self.enabling.is_started
        if is_first and self.enabling.start(self.before):
            self.on_restored()
        ticks = tick - self.arm.tick
        self.arm.late_s = self.late_s
        self.arm.step(ticks)
        self.arm.report_braking()
        if is_first or ticks == self.context.every:
            return False
        self.motors.drop_cycle()
        return True

    def _check_arm(self, sensed: Sensed, missed: bool, tick: int) -> Reaction:
        """Check sample, contacts, limits and drives, and return the reaction of this cycle."""
        contact = self.arm.contact
        enabling = self.enabling
        was_taken_over = enabling.is_taken_over
        if enabling.adopt_pose(sensed, tick):
            wanted = None if missed or self.abandoned else self._wanted
            self.sensors.check_sample(sensed, tick, wanted, contact is not None)
        if enabling.is_taken_over and not was_taken_over:
            self.on_adopted()
        if contact is not None:
            blow = Cause(Error.TOUCHED, f"unintended contact: {self.arm.describe_contact(contact)}")
            self.stopping.register_blow(blow, Finding(Alarm.COLLISION, *contact), tick)
        if enabling.is_taken_over and self.arm.exceeded is not None:
            finding, text = self.arm.exceeded
            cause = Cause(Error.LIMIT, text, finding.subject, finding.value)
            self.stopping.register_blow(cause, finding, tick)
        self.sense_contact(tick)
        if serial := enabling.pop_finished_command():
            self._orders.report_completed(serial)
        if enabling.is_enabled:
            return self.stopping.decide_reaction(self.demand, self.sensors, tick)
        error = Error.DRIVES if self.arm.state is DriveState.FAULT else Error.DISABLED
        return self.stopping.wait_for_enabling(error, enabling.reason, tick)

    def brake_arm(self) -> None:
        """Engage the brakes, and abandon the set points."""
        self.arm.brake()
        self.motors.drop_cycle()
        self._wanted = self.sensors.state
        self.abandoned = True

    def _drive_arm(self, sensed: Sensed, reaction: Reaction, missed: bool, tick: int) -> None:
        """Drive the arm for one cycle.

        The arm is braked instead if there is no wanted motion, a motor fails, the arm refuses the
        command, or a stop is complete.
        """
        wanted = self.next_motion(reaction, missed, tick)
        if wanted is None:
            return self.brake_arm()
        self.terms = self.find_terms()
        failed = self.motors.check_cycle(
            wanted.table, self.sensors.state, self.terms, self.holds_part
        )
        if failed is not None:
            on_failure = self.stopping.register_motor_failure(failed, tick)
            if on_failure is Reaction.BRAKE:
                return self.brake_arm()
        if reaction is Reaction.STOP and (self.abandoned or not wanted.velocity.any()):
            return self.brake_arm()
        torque, grip_force = self.compute_efforts(wanted, sensed)
        if self.set_point_law is None:
            refused = self._link.drive(torque, grip_force)
        else:
            target = self.set_point_law.compute_target(wanted, self.sensors.position, torque)
            refused = self._link.follow(target, grip_force)
        if refused is not None:
            # The arm has engaged its brakes itself when it refused the command.
            self.stopping.register_refusal(refused, tick)
            return self.brake_arm()
        self._wanted = wanted.table
        self.abandoned = False
        self.stopping.refused = None
        return self.motors.begin_cycle()
