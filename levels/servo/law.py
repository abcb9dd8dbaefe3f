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
from typing import Any, ClassVar

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.errors import LevelError
from rack.levels.level import Input, LevelContext, Misfits, Output, Verdict
from rack.levels.messages import ArmState, JointCommand, ServoPlan, ServoStatus
from rack.levels.operator import DRIVES, Goal, Operation, OperatorCommand
from rack.levels.robot.dynamics import Payload
from rack.levels.servo import control, curves, reference
from rack.levels.servo.arm_report import SetPointStatus
from rack.levels.servo.control import Grip, LawParams, limit_torques
from rack.levels.servo.curves import Motion, SensedMotion
from rack.levels.servo.driver import SCENES, ArmDriver
from rack.levels.servo.modification import misfits_of, names_of
from rack.levels.servo.modified_law import LawInputs, ModifiedLaw
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
    operator = Input(OperatorCommand, "own.operator")
    status = Output(ServoStatus)
    state = Output(ArmState)
    scene = SCENES
    commands = {
        Operation.HOLD: (),
        Operation.RESUME: (),
        Operation.SETPOINT: (Goal.JOINTS,),
        Operation.MODIFY: (Goal.ON, Goal.OFF),
        Operation.SET: (),
        **dict.fromkeys(DRIVES, ()),
    }
    params: ClassVar[type[LawParams]] = LawParams
    settings: LawParams
    preloads = (control, curves, reference)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = self.cell
        self.reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self.reference.part = self.part
        self._limits = cell.bounds.torque
        # (joints,), N m: torques of the law after limiting.
        self._torque: Array = np.zeros(len(cell.home))
        self._limit = limit_torques.load()
        self._cut = 0  # cycles in which a limit cut a torque of the law
        self._sensed = SensedMotion(self.sensors.state)
        self._holds = False
        self._payload: Payload | None = None
        self._modified = ModifiedLaw(context, self.settings, self._limits, self.findings)
        joints = context.robot.joints
        self.operator_control = OperatorControl(
            self.commands, joints, cell.limits.position, obey=self._obey
        )
        self.orders = self.operator_control.orders
        self._grip = None if context.robot.gripper is None else Grip(context.robot.gripper)

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of the control modifications."""
        return names_of(params)

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield control modifications that do not suit the law, and what `ArmDriver` yields."""
        yield from super().misfits(context, above, below)
        yield from misfits_of(context)
        interface = context.robot.interface
        if interface != "torque" and (names := cls.names(context.params)):
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
        """Process a new operator's command, plan or set point."""
        if self.operator.verdict is Verdict.NEW:
            self.operator_control.take(self.operator, self.sensors.position)
        if self.plan.verdict is Verdict.NEW:
            self.take_plan(self.plan.message)
        if self.above.verdict is Verdict.NEW:
            command = self.above.message
            self.followed = command.id
            self.rests_on = command.operator
            self.reference.take(command)
            if self._grip is not None:
                self._grip.take(command)

    def take_plan(self, plan: ServoPlan) -> None:
        """Take over the payload in the gripper."""
        self._holds = plan.held >= 0
        self._payload = Payload(plan.payload_mass, plan.payload_offset.copy())

    def _obey(self, command: OperatorCommand) -> str:
        """Obey a command that leaves the one in force unchanged.

        Returns:
            Why it is refused, or an empty text.
        """
        if command.what == Operation.MODIFY:
            return self._modified.switch(command.name, command.goal == Goal.ON)
        if command.what == Operation.SET:
            self.settings, refusal = set_live(self.settings, command.name)
            return refusal
        refusal = self.obey(command)
        self.reference.part = self.part
        return refusal

    def adopted(self) -> None:
        """Forget the operator's way back, because the arm may have been moved away from it."""
        self.operator_control.forget()

    def started(self) -> None:
        """Keep the grip on a held part."""
        if self._grip is not None:
            self._grip.keep(self.arm.grip_force)

    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion:
        """Return the wanted motion. After braking it begins where the arm is."""
        sensors = self.sensors
        reference = self.reference
        if self.abandoned:
            reference.start(sensors.position, sensors.velocity, tick)
        elif self.ahead is not None and self.arm.braked:
            # The first set point after braking must be exactly where the arm is.
            reference.meet(sensors.position, sensors.velocity, tick, tolerance_rad=0.0)
        elif missed:
            reference.meet(sensors.position, sensors.velocity, tick)
        if reaction:
            return reference.rest(tick)
        return (
            self.operator_control.wanted(reference, tick)
            if self.operator_control.stands
            else reference.at(tick)
        )

    def efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Return the torques, N m, and the grip force, N."""
        grip = self._grip
        grip_force = 0.0 if grip is None else grip.force(sensed.opening, sensed.opening_velocity)
        # For set points the torques are predicted, as if the arm were at its set point.
        state = self._sensed if self.ahead is None else SensedMotion(wanted.table[:2])
        if not self._modified.exists:
            return self._limited(wanted, state), grip_force
        terms = self.terms
        inputs = LawInputs(
            wanted, state.table, np.diagonal(terms.inertia), terms.bias, self.arm.tick
        )
        return self._modified.torque(
            lambda motion, seen: self._limited(motion, SensedMotion(seen)), inputs
        ), grip_force

    def _limited(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques of the law, cut at their limits. Valid until the next call.

        Raises:
            LevelError: `torques` did not return one number for each joint.
        """
        torque = self._torque
        unlimited = self.torques(set_point, sensed)
        if getattr(unlimited, "shape", None) != torque.shape:
            shapes = f"shape {np.shape(unlimited)}; expected {torque.shape}, one for each joint"
            raise LevelError(f"class {type(self).__name__}: torques() returned {shapes}")
        torque[:] = unlimited
        if self._limit(torque, self._limits):
            self._cut += 1
        return torque

    def brake(self) -> None:
        """Brake, and abandon set points and torques."""
        super().brake()
        self._modified.interrupt()

    @property
    def payload(self) -> Payload | None:
        """Payload in the gripper according to the plan."""
        return self._payload

    @property
    def holds(self) -> bool:
        """True if the gripper holds a part according to the plan."""
        return self._holds

    def course(self, reaction: Reaction) -> SetPointStatus:
        """Return how the level follows its set points, for the status."""
        operator = self.operator_control
        stands = operator.stands
        cut = self.reference.refused + self._cut
        reason = self.stopping.reason
        if stands and not reason:
            reason = operator.reason
        holding = self.abandoned or self.reference.holding
        stopped = self.abandoned or reaction > 0 or stands
        note = self._modified.reason
        return SetPointStatus(
            self.followed, holding, stopped, cut, reason, has_work=self.followed > 0, note=note
        )
