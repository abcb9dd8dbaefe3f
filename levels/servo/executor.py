"""The servo level of NASREM: computed torque, or set points for closed-loop drives."""

from __future__ import annotations

from typing import ClassVar

from rack.levels.algebra import Array
from rack.levels.level import LevelContext
from rack.levels.messages import ServoPlan
from rack.levels.operator import OperatorCommand
from rack.levels.servo.control import ComputedTorque, ServoParams, SetPointLaw
from rack.levels.servo.curves import Motion, SensedMotion
from rack.levels.servo.law import ServoLaw


class ServoExecutor(ServoLaw):
    """Follows joint set points by computed torque.

    Drives that close a position or velocity loop themselves get set points instead of torques.
    """

    params: ClassVar[type[ServoParams]] = ServoParams
    settings: ServoParams
    gives_set_points = True

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._loop = ComputedTorque(self.arm.dynamics.dry, self.settings)
        if self.cell.interface != "torque":
            self.set_point_law = SetPointLaw(self.cell, self.settings, context.period_s)

    def take_plan(self, plan: ServoPlan) -> None:
        """Adopt the payload in the gripper and the planned inertia."""
        super().take_plan(plan)
        self._loop.inertia = plan.inertia.copy()

    def _obey_command(self, command: OperatorCommand) -> str:
        """Carry out a command, and update the gains of the loops, which it may have changed."""
        refusal = super()._obey_command(command)
        self._loop.set_gains(self.settings)
        if self.set_point_law is not None:
            self.set_point_law.set_gains(self.settings)
        return refusal

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), N m. The array is valid until the next call."""
        return self._loop.compute_torque(set_point, sensed, self.terms)
