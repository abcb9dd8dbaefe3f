"""The executor of a board that servoes some or all joints of an arm on another board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.level import OPERATOR, Executor, Input, LevelContext, Mismatches, Output
from rack.levels.messages import Error
from rack.levels.operator import HOLD_COMMANDS, Goal, Operation, OperatorCommand
from rack.levels.robot import dynamics
from rack.levels.robot.cell import build_level_cell
from rack.levels.servo import curves, reference
from rack.levels.servo.arm_report import view_numbers
from rack.levels.servo.control import Grip, LoopGains
from rack.levels.servo.curves import Motion
from rack.levels.servo.modification import (
    ModifiableParams,
    find_unsuitable_modifications,
    list_names,
)
from rack.levels.servo.modified_law import ModifiedLaw
from rack.levels.servo.operator_control import OperatorControl
from rack.levels.servo.reference import Reference
from rack.levels.systems.joint_boards import joint_control
from rack.levels.systems.joint_boards.joint_control import AT, DUE, JointLoads, servo_joints
from rack.levels.systems.joint_boards.messages import (
    ArmStatus,
    JointReference,
    JointStatus,
    JointTorque,
)
from rack.levels.tables import read_params, set_live

ARM_LOST = "no status from the board of the arm: waiting for it"


class JointServoParams(ModifiableParams, LoopGains):
    """`[board.<name>.params]`: the joints that a board servoes, and the gains of their loop."""

    joints: tuple[str, ...] | None = None
    """joints of `robot.joints` that the board servoes; default: all"""
    gripper: bool = False
    """true if the board also drives the gripper"""


class JointServo(Executor):
    """Follows references with the torques of some joints; other boards drive the others.

    Set points are interpolated for all joints, so that all of them come to rest at the same time
    even if different boards drive them. While the arm is braked, the set point is its position.
    While the arm reports `stopped`, the joints come to rest.
    """

    above = Input(JointReference, "above.command")
    below = Input(ArmStatus, "below.status")
    operator = OPERATOR
    command = Output(JointTorque, rests_on=above)
    status = Output(JointStatus, rests_on=below)
    commands = {
        **HOLD_COMMANDS,
        Operation.SETPOINT: (Goal.JOINTS,),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
    }
    params = JointServoParams
    settings: JointServoParams
    preloads = (curves, dynamics, reference, joint_control)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        robot = context.robot
        cell = build_level_cell(context)
        names = robot.joints if params.joints is None else params.joints
        self._driven = np.array([name in names for name in robot.joints])
        self._constants = constants = np.zeros((5, len(robot.joints)))  # rows of `servo_joints`
        params.fill_constants(constants)
        constants[2] = cell.model.dof_frictionloss[cell.dof]
        constants[3] = cell.bounds.torque
        constants[4] = self._driven
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self.loads = JointLoads(cell)
        self._servo = partial(servo_joints.load_machine_code(), constants, self.loads.table)
        self._modified = ModifiedLaw(context, params, cell.bounds.torque, self.findings)
        self.operator_control = OperatorControl(
            self._orders, robot.joints, cell.limits.position, self._driven, obey=self._obey_command
        )
        # Output of the law when modifications call it.
        self._unmodified: Array = np.zeros(7 * len(robot.joints))
        self._grip = Grip(robot.gripper) if params.gripper and robot.gripper is not None else None
        below = max(pace.every for pace in context.below.values())
        # Permitted age of a status in ticks. During shorter stalls of its board the arm keeps the
        # last torques.
        self._oldest = below + cell.patience.ticks(below, context.tick_s)
        self._sample: Array  # positions and velocities in the status of the arm
        self._shown_numbers: tuple[Array, ...] = ()  # numbers of the messages to write
        self._offered: JointReference | None = None  # reference whose loads are not used yet
        self._rests_on = 0
        self._refused = ""  # why the newest reference was refused
        self._met = False  # a status of the arm has arrived

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the control modifications."""
        return list_names(params)

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield a mismatch for each invalid joint and modification, or if nothing is driven."""
        params = read_params(JointServoParams, context.params)
        known = context.robot.joints
        named = known if params.joints is None else params.joints
        for joint in dict.fromkeys(named):
            if joint not in known:
                yield (
                    "params.joints",
                    joint,
                    f"the arm has no such joint; joints: {', '.join(known)}",
                )
            elif named.count(joint) > 1:
                yield "params.joints", joint, "named twice"
        if not named and not params.gripper:
            yield "params.joints", [], "it drives no joint, and not the gripper"
        yield from find_unsuitable_modifications(context)

    def process(self, tick: int) -> None:
        """Run one cycle: compute the torques that act from the next cycle on."""
        arm = self.below.message
        if not self._met and not self._initialize_from_status(arm):
            return
        self._take_messages()
        sampled = arm.tick
        every = self.context.every
        reference = self.reference
        operator = self.operator_control
        is_silent = self.below.is_lost or tick - sampled > self._oldest
        stopped = is_silent or arm.stopped
        if is_silent or (stopped and arm.braked):
            reference.start(arm.position, arm.velocity, tick)
            self._modified.forget_torque()
        wanted = (
            reference.ramp_to_rest(tick) if stopped else operator.compute_motion(reference, tick)
        )
        # Use the inertia and the load of the reference that is followed, else compute them.
        if stopped or operator.is_in_control or reference.holding:
            self.loads.compute_at_rest(arm.position)
        elif self._offered is not None:
            self.loads.take_reference(self._offered, tick)
            self.status.due = self._offered.due
            self._offered = None
        tick_s = self.context.tick_s
        age_s = min(tick + every - sampled, self._oldest + every) * tick_s
        times = self.loads.compute_passed_part(tick), every * tick_s, age_s
        self._servo(*times, self._sample, wanted.table, *self._shown_numbers)
        if self._modified.has_modifications:
            self._apply_modifications(times, wanted, tick)
        torque = self.command
        torque.sampled = sampled
        torque.id += 1
        if self._grip is not None:
            torque.grip_force = self._grip.compute_force(arm.opening, arm.opening_velocity)
        torque.operator = operator.orders.find_basis(self._rests_on)
        self._write_status(self.status, arm, is_silent, stopped)
        operator.orders.fill_status(self.status, self._rests_on)

    def _obey_command(self, command: OperatorCommand) -> str:
        """Switch a modification or set a parameter.

        Returns:
            The reason for a failure, or an empty string.
        """
        if command.what == Operation.MODIFY:
            return self._modified.switch_modification(command.name, command.goal == Goal.ON)
        self.settings, refusal = set_live(self.settings, command.name)
        self.settings.fill_constants(self._constants)
        return refusal

    def _apply_modifications(
        self, times: tuple[float, float, float], wanted: Motion, tick: int
    ) -> None:
        """Replace the torques just computed with the torques of the modified law.

        Args:
            times: Fraction of the interval that has passed, time until the torques act, s, and age
                of the sample at that time, s.
            wanted: Motion to follow.
            tick: Tick of the cycle.
        """
        joints = len(self._driven)
        table = self.loads.table
        command, shown_status = self._shown_numbers
        torque = self._unmodified[: 3 * joints]
        status = self._unmodified[3 * joints :]

        def compute_unmodified(motion: Motion, state: Array) -> Array:
            """Return the torques of the unmodified law for a motion at a state."""
            self._servo(*times, state.reshape(-1), motion.table, torque, status)
            return torque[:joints]

        inertia, load = table[AT] + times[0] * (table[DUE] - table[AT])
        state = self._sample.reshape(2, joints)
        modified = self._modified.compute_torque(
            compute_unmodified, wanted, state, inertia, load, tick
        )
        np.copyto(command[:joints], modified, where=self._driven)
        np.copyto(shown_status[3 * joints :], modified, where=self._driven)

    def _initialize_from_status(self, arm: ArmStatus) -> bool:
        """Initialise from the first status of the arm. Return False if none has arrived yet."""
        status = self.status
        torque = self.command
        self._met = self.below.has_message
        if not self._met:
            torque.sampled = -1
            status.driven = self._driven
            status.holding = True
            status.stopped = True
            return False
        if self._grip is not None and arm.grip_force:
            self._grip.keep_force(arm.grip_force)
        self._sample = view_numbers(arm, "position", "velocity")
        self._shown_numbers = (
            view_numbers(torque, "torque", "target_velocity"),
            view_numbers(status, "position", "torque"),
        )
        return True

    def _take_messages(self) -> None:
        """Process a new operator's command and a new reference."""
        if self.operator.is_new:
            self.operator_control.take_commands(self.operator, self.below.message.position)
        if self.above.is_new:
            command = self.above.message
            self.status.echo = command.id
            self._rests_on = command.operator
            self._refused = ""
            if misfit := self.loads.find_invalid_field(command):
                # Before the first set point all fields are zero, which is not an error.
                if command.due:
                    self._refused = f"rejected: a reference whose {misfit} is out of range"
                return
            self.reference.take_command(command)
            self._offered = command
            if self._grip is not None:
                self._grip.take_command(command)
                self.command.payload_mass = command.payload_mass
                self.command.payload_offset = command.payload_offset

    def _write_status(
        self, status: JointStatus, arm: ArmStatus, is_silent: bool, stopped: bool
    ) -> None:
        """Fill the fields of the status that the law does not set.

        Args:
            status: Status to write.
            arm: Status of the arm.
            is_silent: True if the status of the arm is missing or too old.
            stopped: True if the joints must come to rest.
        """
        operator = self.operator_control
        holding = self.reference.holding
        reason = operator.reason
        error = Error.NONE
        if is_silent:
            reason = ARM_LOST
        elif stopped:
            reason = f"arm: {arm.reason}"
            if arm.state == State.ERROR:
                error = Error(arm.error)
        status.driven = self._driven
        status.holding = holding
        status.stopped = stopped or operator.is_in_control
        status.reason = reason or self._refused or self._modified.reason
        status.error = error
        if error:
            status.state = State.ERROR
        else:
            resting = State.IDLE if holding else State.EXECUTING
            status.state = State.HOLDING if reason and status.echo else resting
