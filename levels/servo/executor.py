"""The executor of the servo level: in every cycle torques for the arm, or a stop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.level import Input, LevelContext, Misfits, Output, Verdict
from rack.levels.messages import ArmState, JointCommand, ServoPlan, ServoStatus
from rack.levels.operator import DRIVES, Goal, Operation, OperatorCommand
from rack.levels.robot.dynamics import Terms
from rack.levels.servo import control, curves, reference
from rack.levels.servo.control import ComputedTorque, Grip, ServoParams, SetPointLaw
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import SCENES, ArmDriver, Course
from rack.levels.servo.modification import misfits_of, names_of
from rack.levels.servo.modified_law import LawInputs, ModifiedLaw
from rack.levels.servo.operator_control import OperatorControl
from rack.levels.servo.reference import Reference
from rack.levels.servo.stopping import Reaction
from rack.levels.tables import read_params, set_live


class ServoExecutor(ArmDriver):
    """Follows joint set points with torques. Safety comes first, an operator's command second, the
    level above third.

    See `ArmDriver`.
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
    params: ClassVar[type[ServoParams]] = ServoParams
    preloads = (control, curves, reference)
    gives_set_points = True

    def __init__(self, context: LevelContext) -> None:
        self.given = params = read_params(self.params, context.params)
        super().__init__(context, params)
        cell = self.cell
        self.reference = Reference(
            cell.bounds, cell.limits, context.tick_s
        )  # set points, interpolated
        self.reference.part = self.part
        self._loop = ComputedTorque(cell, params, self.arm.dynamics)
        if cell.interface != "torque":
            self.ahead = SetPointLaw(cell, params, context.period_s)
        self._modified = ModifiedLaw(context, params, cell.bounds.torque, self.findings)
        joints = context.robot.joints
        self.operator_control = OperatorControl(
            self.commands, joints, cell.limits.position, obey=self._obey
        )
        self.orders = self.operator_control.orders
        self._grip = None if context.robot.gripper is None else Grip(context.robot.gripper)

    @classmethod
    def names(cls, params: Mapping[str, Any]) -> Sequence[str]:
        """Return the names of its control modifications."""
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

    def take_messages(self) -> None:
        """Take over what is new."""
        if self.operator.verdict is Verdict.NEW:
            self.operator_control.take(self.operator, self.sensors.position)
        if self.plan.verdict is Verdict.NEW:
            self._loop.take(self.plan.message)
        if self.above.verdict is Verdict.NEW:
            command = self.above.message
            self.followed = command.id
            self.rests_on = command.operator
            self.reference.take(command)
            if self._grip is not None:
                self._grip.take(command)

    def _obey(self, command: OperatorCommand) -> str:
        """Do what leaves the command in force as it is; return why not, empty: it does."""
        if command.what == Operation.MODIFY:
            return self._modified.switch(command.name, command.goal == Goal.ON)
        if command.what == Operation.SET:
            return self._tune(command.name)
        why = self.obey(command)
        self.reference.part = self.part
        return why

    def _tune(self, setting: str) -> str:
        """Set a live parameter; return why not, empty: it is set."""
        self.given, why = set_live(self.given, setting)
        self._loop.tune(self.given)
        if self.ahead is not None:
            self.ahead.tune(self.given)
        return why

    def adopted(self) -> None:
        """Forget the operator's way: the arm may have been moved away from it."""
        self.operator_control.forget()

    def started(self) -> None:
        """Keep the grip on a part."""
        if self._grip is not None:
            self._grip.keep(self.arm.grip_force)

    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion:
        """Return the wanted motion; after braking it begins where the arm is."""
        sensors = self.sensors
        reference = self.reference
        if self.abandoned:
            reference.start(sensors.position, sensors.velocity, tick)
        elif self.ahead is not None and self.arm.braked:
            # The first set point after brakes is where the arm is.
            reference.meet(sensors.position, sensors.velocity, tick, astray=0.0)
        elif missed:
            reference.meet(sensors.position, sensors.velocity, tick)
        if reaction:
            return reference.rest(tick)
        return (
            self.operator_control.wanted(reference, tick)
            if self.operator_control.stands
            else reference.at(tick)
        )

    def terms(self) -> Terms:
        """Return the equation of motion at the sensed state, with the held object."""
        return self._loop.terms(self.sensors.position, self.sensors.velocity)

    def torques(self, wanted: Motion, sensed: Sensed, terms: Terms) -> tuple[Array, float]:
        """Return the torques, N m, and the grip force, N."""
        grip = self._grip
        grip_force = 0.0 if grip is None else grip.force(sensed.opening, sensed.opening_velocity)
        loop = self._loop
        # What is predicted for set points is the torque of an arm that is there.
        state = self.sensors.state if self.ahead is None else wanted.table
        if not self._modified.exists:
            return loop.torque(wanted, state, terms), grip_force
        given = LawInputs(wanted, state, np.diagonal(terms.inertia), terms.bias, self.arm.tick)

        def law(motion: Motion, seen: Array) -> Array:
            return loop.torque(motion, seen, terms)

        return self._modified.torque(law, given), grip_force

    def brake(self) -> None:
        """Brake, and abandon set points and torques."""
        super().brake()
        self._modified.interrupt()

    @property
    def holds(self) -> bool:
        """Whether the gripper holds a part, by the plan."""
        return self._loop.holds

    @property
    def note(self) -> str:
        """How the law is modified."""
        return self._modified.reason

    def course(self, reaction: Reaction) -> Course:
        """Return what the status says of set points."""
        operator = self.operator_control
        cut = self.reference.refused + self._loop.cut
        kept = self.stopping.reason
        if operator.stands and not kept:
            kept = operator.reason
        holding = self.abandoned or self.reference.holding
        stopped = self.abandoned or reaction > 0 or operator.stands
        return Course(self.followed, holding, stopped, cut, kept)
