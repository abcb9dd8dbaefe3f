"""A servo law: the part of a servo level that turns set points into torques.

```python
class PdServo(ServoLaw):
    params = Gains
    settings: Gains

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        error = set_point.position - sensed.position
        slip = set_point.velocity - sensed.velocity
        correction = self.settings.stiffness * error + self.settings.damping * slip
        return self.terms.inertia.diagonal() * correction + self.terms.bias
```
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.errors import LevelError
from rack.levels.level import OPERATOR, Input, LevelContext, Mismatches, Output
from rack.levels.messages import ArmState, JointCommand, ServoPlan, ServoStatus
from rack.levels.operator import (
    DRIVE_OPERATIONS,
    HOLD_COMMANDS,
    Goal,
    Operation,
    OperatorCommand,
)
from rack.levels.robot.dynamics import Payload
from rack.levels.servo import control, curves, reference
from rack.levels.servo.arm_report import SetPointStatus
from rack.levels.servo.control import (
    Grip,
    LawParams,
    ServoParams,
    SetPointLaw,
    limit_torques,
    set_torque,
)
from rack.levels.servo.curves import Motion, SensedMotion
from rack.levels.servo.driver import SCENES, ArmDriver
from rack.levels.servo.modification import find_unsuitable_modifications, list_names
from rack.levels.servo.modified_law import ModifiedLaw
from rack.levels.servo.operator_control import OperatorControl
from rack.levels.servo.reference import Reference
from rack.levels.servo.stopping import Reaction
from rack.levels.tables import set_live


class ServoLaw(ArmDriver):
    """Follows joint set points with the torques of a law. Subclasses define `torques`.

    Safety comes first, an operator's command second, the level above third: see `ArmDriver`. Set
    points are interpolated. Torques are cut at the motors' limits; a torque of NaN engages the
    brakes. The parameters of the law, a subclass of `LawParams`, are in `settings`.

    Attributes:
        terms: Equation of motion at the sensed state, with the payload: `inertia`, (joints,
            joints), kg m2, and `bias`, (joints,), N m, torques of gravity and velocities.
    """

    above = Input(JointCommand, "above.command")
    plan = Input(ServoPlan, "own.plan")
    before = Input(ArmState, "own.state")
    operator = OPERATOR
    status = Output(ServoStatus)
    state = Output(ArmState)
    scene = SCENES
    commands = {
        **HOLD_COMMANDS,
        Operation.SETPOINT: (Goal.JOINTS,),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
        **dict.fromkeys(DRIVE_OPERATIONS, ()),
    }
    params: ClassVar[type[LawParams]] = LawParams
    settings: LawParams
    preloads = (control, curves, reference)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = self.cell
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self.reference.speed_scale = self.speed_scale
        self._limits = cell.bounds.torque
        # (joints,), N m: torques of the law after limiting.
        self._torque: Array = np.zeros(len(cell.home))
        self._limit = limit_torques.load_machine_code()
        self._cut = 0  # cycles in which a limit cut a torque of the law
        self._sensed = SensedMotion(self.sensors.state)
        self._modified = ModifiedLaw(context, self.settings, self._limits, self.findings)
        self.operator_control = OperatorControl(
            self._orders, cell.joints, cell.limits.position, obey=self._obey_command
        )
        self._grip = None if context.robot.gripper is None else Grip(context.robot.gripper)

    @classmethod
    def list_names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the control modifications."""
        return list_names(params)

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield control modifications that do not suit the law, and mismatches of `ArmDriver`."""
        yield from super().find_mismatches(context)
        yield from find_unsuitable_modifications(context)
        interface = context.robot.interface
        if interface != "torque" and (names := cls.list_names(context.params)):
            why = f'they modify a law of torques; [robot] interface is "{interface}"'
            yield "params.modifications", ", ".join(names), why

    @abstractmethod
    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Compute the torques of one cycle.

        Args:
            set_point: Motion wanted now: `position`, rad, `velocity`, rad/s, and `acceleration`,
                rad/s2, (joints,) each.
            sensed: `position`, rad, and `velocity`, rad/s, (joints,) each; estimated for a joint
                whose sensor is at fault.

        Returns:
            Torques, (joints,), N m.
        """

    def take_messages(self) -> None:
        """Process the new messages of this cycle: operator's command, plan and set point."""
        if self.operator.is_new:
            self.operator_control.take_commands(self.operator, self.sensors.position)
        if self.plan.is_new:
            self.take_plan(self.plan.message)
        if self.above.is_new:
            command = self.above.message
            self.followed = command.id
            self.rests_on = command.operator
            self.reference.take_command(command)
            if self._grip is not None:
                self._grip.take_command(command)

    def take_plan(self, plan: ServoPlan) -> None:
        """Adopt the payload in the gripper from a new plan."""
        self.holds_part = plan.held >= 0
        self.payload = Payload(plan.payload_mass, plan.payload_offset.copy())

    def _obey_command(self, command: OperatorCommand) -> str:
        """Carry out a setting or a drive command, neither of which ends a HOLD or SETPOINT.

        Returns:
            Reason for the refusal, or an empty string.
        """
        if command.what == Operation.MODIFY:
            return self._modified.switch_modification(command.name, command.goal == Goal.ON)
        if command.what == Operation.SET:
            self.settings, refusal = set_live(self.settings, command.name)
            return refusal
        refusal = self.obey_drive_command(command)
        self.reference.speed_scale = self.speed_scale
        return refusal

    def on_adopted(self) -> None:
        """Discard the operator's return path, because the arm may have been moved by hand."""
        self.operator_control.return_path.clear()

    def on_restored(self) -> None:
        """Keep the force of the gripper, so that a held part is not dropped."""
        if self._grip is not None:
            self._grip.keep_force(self.arm.grip_force)

    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion:
        """Return the motion wanted in this cycle, from the operator or from the level above.

        After braking, the motion begins at the position of the arm. If there is a reaction, the
        motion ramps to rest.

        Args:
            reaction: Reaction of this cycle.
            missed: True if cycles before this one were missed.
            tick: Tick of the cycle.
        """
        sensors = self.sensors
        reference = self.reference
        if self.abandoned:
            reference.start(sensors.position, sensors.velocity, tick)
        elif self.set_point_law is not None and self.arm.braked:
            # The first set point after braking must be exactly where the arm is.
            reference.restart_if_astray(sensors.position, sensors.velocity, tick, tolerance_rad=0.0)
        elif missed:
            reference.restart_if_astray(sensors.position, sensors.velocity, tick)
        if reaction:
            return reference.ramp_to_rest(tick)
        return self.operator_control.compute_motion(reference, tick)

    def compute_efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Return the torques in N m, and the force of the gripper in N."""
        grip = self._grip
        grip_force = (
            0.0 if grip is None else grip.compute_force(sensed.opening, sensed.opening_velocity)
        )
        # For drives that follow set points, predict the torques of an arm at its set point.
        state = self._sensed if self.set_point_law is None else SensedMotion(wanted.table[:2])
        if not self._modified.has_modifications:
            return self._compute_limited_torque(wanted, state), grip_force
        terms = self.terms
        return self._modified.compute_torque(
            lambda motion, seen: self._compute_limited_torque(motion, SensedMotion(seen)),
            wanted,
            state.table,
            np.diagonal(terms.inertia),
            terms.bias,
            self.arm.tick,
        ), grip_force

    def _compute_limited_torque(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques of the law, cut at their limits.

        The array is valid until the next call.

        Raises:
            LevelError: `torques` did not return one number for each joint.
        """
        torque = self._torque
        unlimited = self.torques(set_point, sensed)
        if getattr(unlimited, "shape", None) != torque.shape:
            raise LevelError(
                f"class {type(self).__name__}: torques() returned shape {np.shape(unlimited)};"
                f" expected {torque.shape}, one for each joint"
            )
        torque[:] = unlimited
        self._cut += self._limit(torque, self._limits)
        return torque

    def brake_arm(self) -> None:
        """Engage the brakes, abandon the set points, and forget the last torque."""
        super().brake_arm()
        self._modified.forget_torque()

    def report_set_points(self, reaction: Reaction) -> SetPointStatus:
        """Return the section of the status that reports on the set points."""
        operator = self.operator_control
        return SetPointStatus(
            command=self.followed,
            holding=self.abandoned or self.reference.holding,
            stopped=self.abandoned or reaction > 0 or operator.is_in_control,
            cut=self.reference.refused + self._cut,
            reason=self.stopping.reason or operator.reason,
            has_work=self.followed > 0,
            note=self._modified.reason,
        )


class ServoExecutor(ServoLaw):
    """Follows joint set points by computed torque: M (qdd + K e + D de) + bias + friction.

    M is the planner's inertia, or the arm's own before the first plan. Drives that close a position
    or velocity loop themselves get set points instead of torques.
    """

    params: ClassVar[type[ServoParams]] = ServoParams
    settings: ServoParams
    gives_set_points = True

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        dry = self.arm.dynamics.dry
        self._constants = np.zeros((4, len(dry)))  # in the rows of `set_torque`
        self._constants[2] = dry
        self._set_torque = partial(set_torque.load_machine_code(), self._constants)
        self._inertia: Array | None = None
        if self.cell.interface != "torque":
            self.set_point_law = SetPointLaw(self.cell, self.settings, context.period_s)
        self.settings.fill_constants(self._constants)

    def take_plan(self, plan: ServoPlan) -> None:
        """Adopt the payload in the gripper and the planned inertia."""
        super().take_plan(plan)
        self._inertia = plan.inertia.copy()

    def _obey_command(self, command: OperatorCommand) -> str:
        """Carry out a command, and update the gains of the loops, which it may have changed."""
        refusal = super()._obey_command(command)
        self.settings.fill_constants(self._constants)
        if self.set_point_law is not None:
            self.set_point_law.set_gains(self.settings)
        return refusal

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), N m. The array is valid until the next call."""
        inertia = self.terms.inertia if self._inertia is None else self._inertia
        self._set_torque(set_point.table, sensed.table, inertia, self.terms.bias)
        torque: Array = self._constants[3]
        return torque
