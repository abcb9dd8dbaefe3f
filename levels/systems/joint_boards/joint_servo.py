"""The executor of a board that servoes some or all joints of an arm whose plant is on a board of
its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.level import Executor, Input, LevelContext, Misfits, Output
from rack.levels.messages import Error
from rack.levels.operator import HOLDABLE, Goal, Operation, OperatorCommand
from rack.levels.robot import dynamics
from rack.levels.robot.cell import cell_of
from rack.levels.servo import curves, reference
from rack.levels.servo.control import Grip, LoopGains
from rack.levels.servo.curves import Motion
from rack.levels.servo.arm_report import numbers
from rack.levels.servo.modification import ModifiableParams, misfits_of, names_of
from rack.levels.servo.modified_law import LawInputs, ModifiedLaw
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
    """joints of `robot.joints` that it servoes; default: all"""
    gripper: bool = False
    """true: it drives the gripper, too"""


class JointServo(Executor):
    """Follows references with the torques of its own joints, and leaves the rest of the arm to
    other boards.

    Set points are interpolated for all joints, so that all of them come to rest at the same time,
    on whichever boards. While the arm is braked they begin where it is; while the arm says
    `stopped`, they come to rest.
    """

    above = Input(JointReference, "above.command")
    below = Input(ArmStatus, "below.status")
    operator = Input(OperatorCommand, "own.operator")
    command = Output(JointTorque, rests_on=above)
    status = Output(JointStatus, rests_on=below)
    commands = {
        **HOLDABLE,
        Operation.SETPOINT: (Goal.JOINTS,),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
    }
    params = JointServoParams
    preloads = (curves, dynamics, reference, joint_control)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._given = params = read_params(JointServoParams, context.params)
        robot = context.robot
        cell = cell_of(context)
        names = robot.joints if params.joints is None else params.joints
        self._driven = np.array([name in names for name in robot.joints])
        self._constants = constants = np.zeros((5, len(robot.joints)))  # rows of `servo_joints`
        params.fill(constants)
        constants[2] = cell.model.dof_frictionloss[cell.dof]
        constants[3] = cell.bounds.torque
        constants[4] = self._driven
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self.loads = JointLoads(cell)
        self._servo = partial(servo_joints.load(), constants, self.loads.table)
        self._modified = ModifiedLaw(context, params, cell.bounds.torque, self.findings)
        self.operator_control = OperatorControl(
            self.commands, robot.joints, cell.limits.position, self._driven, obey=self._obey
        )
        # What the law sets for its modifications.
        self._unmodified: Array = np.zeros(7 * len(robot.joints))
        self._grip = Grip(robot.gripper) if params.gripper and robot.gripper is not None else None
        below = max(pace.every for pace in context.below.values())
        # Ticks, of a status: while its board stalls for less, the arm goes on with the last
        # torques.
        self._oldest = below + cell.patience.ticks(below, context.tick_s)
        self._sample: Array  # numbers of a status of the arm
        self._shown_numbers: tuple[Array, ...] = ()  # of the messages to write
        self._offered: JointReference | None = None  # reference whose loads are not yet taken
        self._command = self._rests_on = self._due = 0
        self._refused = ""  # why the newest reference was not taken
        self._met = False  # a status of the arm has come

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of its control modifications."""
        return names_of(params)

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield joints that the arm lacks or that are named twice, an idle board, and modifications
        that do not fit.
        """
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
        yield from misfits_of(context)

    def process(self, tick: int) -> None:
        """Interpolate, and compute the torques that act from the next cycle on."""
        arm = self.below.message
        if not self._met and not self._meet(self.below.is_there, arm):
            return
        self._take_messages()
        sampled = arm.tick
        every = self.context.every
        reference = self.reference
        operator = self.operator_control
        away = self.below.is_lost or tick - sampled > self._oldest
        stopped = away or arm.stopped
        if away or (stopped and arm.braked):
            reference.start(arm.position, arm.velocity, tick)
            self._modified.interrupt()
        if stopped:
            wanted = reference.rest(tick)
        else:
            wanted = operator.wanted(reference, tick) if operator.stands else reference.at(tick)
        # Take over inertia and load of the reference that is followed; compute them while
        # none is.
        if stopped or operator.stands or self.reference.holding:
            self.loads.hold(arm.position)
        elif self._offered is not None:
            self.loads.take(self._offered, tick)
            self._due = self._offered.due
            self._offered = None
        tick_s = self.context.tick_s
        age_s = min(tick + every - sampled, self._oldest + every) * tick_s
        times = self.loads.part(tick), every * tick_s, age_s
        self._servo(*times, self._sample, wanted.table, *self._shown_numbers)
        if self._modified.exists:
            self._modify(times, wanted, tick)
        torque = self.command
        torque.sampled = sampled
        torque.id += 1
        if self._grip is not None:
            torque.grip_force = self._grip.force(arm.opening, arm.opening_velocity)
        torque.operator = operator.orders.rests_on(self._rests_on)
        self._report(self.status, arm, away, stopped)
        operator.orders.report(self.status, self._rests_on)

    def _obey(self, command: OperatorCommand) -> str:
        """Modify the law, or set a live parameter; return why not, empty: it is done."""
        if command.what == Operation.MODIFY:
            return self._modified.switch(command.name, command.goal == Goal.ON)
        self._given, why = set_live(self._given, command.name)
        self._given.fill(self._constants)
        return why

    def _modify(self, times: tuple[float, float, float], wanted: Motion, tick: int) -> None:
        """Replace the torques just set by those of the modified law."""
        joints = len(self._driven)
        table = self.loads.table
        part = times[0]
        given, shown = self._shown_numbers
        torque = self._unmodified[: 3 * joints]
        status = self._unmodified[3 * joints :]

        def law(motion: Motion, state: Array) -> Array:
            self._servo(*times, state.reshape(-1), motion.table, torque, status)
            return torque[:joints]

        inertia, load = table[AT] + part * (table[DUE] - table[AT])
        inputs = LawInputs(wanted, self._sample.reshape(2, joints), inertia, load, tick)
        modified = self._modified.torque(law, inputs)
        np.copyto(given[:joints], modified, where=self._driven)
        np.copyto(shown[3 * joints :], modified, where=self._driven)

    def _meet(self, is_there: bool, arm: ArmStatus) -> bool:
        """Begin with the first status of the arm; return whether there is one."""
        status = self.status
        torque = self.command
        self._met = is_there
        if not is_there:
            torque.sampled = -1
            status.driven = self._driven
            status.holding = True
            status.stopped = True
            return False
        if self._grip is not None and arm.grip_force:
            self._grip.keep(arm.grip_force)
        self._sample = numbers(arm, "position", "velocity")
        self._shown_numbers = (
            numbers(torque, "torque", "target_velocity"),
            numbers(status, "position", "torque"),
        )
        return True

    def _take_messages(self) -> None:
        """Take over what is new."""
        if self.operator.is_new:
            self.operator_control.take(self.operator, self.below.message.position)
        if self.above.is_new:
            command = self.above.message
            self._command = command.id
            self._rests_on = command.operator
            self._refused = ""
            if misfit := self.loads.misfit(command):
                # Before there is a set point, all is zero.
                if command.due:
                    self._refused = f"rejected: a reference whose {misfit} is out of range"
                return
            self.reference.take(command)
            self._offered = command
            if self._grip is not None:
                self._grip.take(command)
                self.command.payload_mass = command.payload_mass
                self.command.payload_offset = command.payload_offset

    def _report(self, status: JointStatus, arm: ArmStatus, away: bool, stopped: bool) -> None:
        """Fill what the law has not set in the status."""
        operator = self.operator_control
        holding = self.reference.holding
        kept = operator.reason
        error = Error.NONE
        if away:
            kept = ARM_LOST
        elif stopped:
            kept = f"arm: {arm.reason}"
            if arm.state == State.ERROR:
                error = Error(arm.error)
        status.driven = self._driven
        status.echo = self._command
        status.holding = holding
        status.stopped = stopped or operator.stands
        status.due = self._due
        status.reason = kept or self._refused or self._modified.reason
        status.error = error
        if error:
            status.state = State.ERROR
        else:
            resting = State.IDLE if holding else State.EXECUTING
            status.state = State.HOLDING if kept and self._command else resting
