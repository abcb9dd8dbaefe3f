"""The servo level of NASREM: computed torque."""

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
    """Follows joint set points by computed torque or, with drives that close loops of their own, by
    set points for them.
    """

    params: ClassVar[type[ServoParams]] = ServoParams
    settings: ServoParams
    gives_set_points = True

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._loop = ComputedTorque(self.arm.dynamics.dry, self.settings)
        if self.cell.interface != "torque":
            self.ahead = SetPointLaw(self.cell, self.settings, context.period_s)

    def take_plan(self, plan: ServoPlan) -> None:
        """Take over what the gripper holds, and the inertia with it."""
        super().take_plan(plan)
        self._loop.inertia = plan.inertia.copy()

    def _obey(self, command: OperatorCommand) -> str:
        """Obey, with the gains as they are set then."""
        why = super()._obey(command)
        self._loop.tune(self.settings)
        if self.ahead is not None:
            self.ahead.tune(self.settings)
        return why

    def torques(self, set_point: Motion, sensed: SensedMotion) -> Array:
        """Return the torques, (joints,), N m. Valid until the next call."""
        return self._loop.torque(set_point, sensed, self.terms)
