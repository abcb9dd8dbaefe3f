"""Link between the servo level and its arm that injects faults into samples, commands and motors.

The steps that carry out the faults are in `rack.levels.fault_steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm.braked_arm import BrakedArm
from rack.levels.arm.link import JointTarget, Link, Sensed
from rack.levels.fault_steps import ActiveFault, CommandStep, Key, MotorStep, SensorStep
from rack.levels.level import Fault, Finding
from rack.levels.robot.dynamics import FRICTION_SPEED
from rack.levels.robot.limits import (
    MAX_CONTACT_FRACTION,
    MAX_RESTING_CONTACT_FRACTION,
    MIN_TURNING_JOINTS,
)

DETECTABLE_TORQUE_FRACTION = 0.02
"""Fraction of its torque limit that a motor must lack for the fault to be detectable.

This is in addition to the torque that friction and a contact may hide.
"""
MIN_TURNING_SPEED = 5.0 * FRICTION_SPEED
"""Velocity above which the direction of dry friction in a joint is known, in rad/s."""


class FaultyLink:
    """Implements `Link`, and applies the injected faults to samples, torques and set points.

    Attributes:
        faultless: The same link to the arm without injected faults.
    """

    def __init__(
        self,
        arm: BrakedArm,
        acted: dict[int, bool],
        link: Link,
        holds: Callable[[], bool],
    ) -> None:
        """Connect the servo level to an arm.

        Args:
            arm: The arm.
            acted: Collects the faults that have an effect, for `Executor.acted`.
            link: Link to the arm, or the arm.
            holds: Returns True if the gripper may hold an object, as far as the level knows.
        """
        cell = arm.cell
        self._arm = arm
        self._holds = holds
        self.faultless = link
        self._effects = acted
        self._limits = limits = cell.bounds.torque
        # Friction may change from helping to resisting, and so hide twice its value.
        self._hidden = (
            DETECTABLE_TORQUE_FRACTION * limits + 2.0 * cell.model.dof_frictionloss[cell.dof]
        )
        # A contact may change from pushing along to pushing back.
        self._pressed = 2.0 * MAX_CONTACT_FRACTION * limits
        self._sensors: list[tuple[SensorStep, ActiveFault]] = []
        # Each with the fraction of its torque limit that the motor still provides.
        self._motors: list[tuple[float, ActiveFault]] = []
        self._commands: list[tuple[CommandStep, ActiveFault]] = []
        self._first_samples: dict[Key, Sensed] = {}
        self._torque = np.zeros(len(limits))

    def inject(self, faults: Sequence[Fault]) -> None:
        """Replace the active faults. Faults of joints that the arm does not have are ignored."""
        active = [
            ActiveFault(place, fault, joints, self._arm.every, self._first_samples)
            for place, fault in enumerate(faults)
            if (joints := fault.mark_joints(len(self._limits))).any()
        ]
        for gone in self._first_samples.keys() - {a.key for a in active}:
            del self._first_samples[gone]
        steps = [(a.fault.step, a) for a in active]
        self._sensors = [(step, a) for step, a in steps if isinstance(step, SensorStep)]
        self._motors = [(step.part(a), a) for step, a in steps if isinstance(step, MotorStep)]
        self._commands = [(step, a) for step, a in steps if isinstance(step, CommandStep)]
        max_torque = np.full(len(self._limits), np.inf)
        for fraction, weak in self._motors:
            np.minimum(max_torque, fraction * self._limits, out=max_torque, where=weak.joints)
        self._arm.weaken(max_torque if self._motors else None)

    def sense(self) -> Sensed:
        """Return the newest sample with the faults applied."""
        sample = self.faultless.sense()
        for step, active in self._sensors:
            sample, must_be_found = step.act(sample, active)
            if must_be_found is not None:
                self._effects[active.place] = must_be_found
        return sample

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Pass on torques with the faults applied."""
        if self._commands:
            torque = self._corrupt_torque(torque)
        finding = self.faultless.drive(torque, grip_force)
        self._record_motor_faults()
        return finding

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Pass on set points, with command faults applied to the predicted torque."""
        if self._commands:
            target = target._replace(torque=self._corrupt_torque(target.torque))
        finding = self.faultless.follow(target, grip_force)
        self._record_motor_faults()
        return finding

    def _record_motor_faults(self) -> None:
        """Record which motor faults had an effect, and whether the effect was detectable."""
        if self._motors and not self._arm.braked:
            commanded = np.abs(self._arm.torque)
            hidden = self._hidden + self._compute_hidden_torque()
            for fraction, active in self._motors:
                missing = (commanded - fraction * self._limits)[active.joints]
                if (missing > 0.0).any():
                    self._effects[active.place] = bool((missing > hidden[active.joints]).any())

    def _compute_hidden_torque(self) -> Array | float:
        """Return the largest lack of motor torque that a contact may hide, in N m.

        The result is (joints,), or 0 without contact.
        """
        if self._arm.is_touching_surroundings:
            return self._pressed
        turning = np.count_nonzero(np.abs(self._arm.sense().velocity) > MIN_TURNING_SPEED)
        return (
            MAX_RESTING_CONTACT_FRACTION * self._limits
            if (self._arm.is_holding_object or self._holds()) and turning < MIN_TURNING_JOINTS
            else 0.0
        )

    def _corrupt_torque(self, torque: Array) -> Array:
        """Return the torques after applying the active command faults, (joints,), in N m."""
        corrupt = self._torque
        np.copyto(corrupt, torque)
        for step, active in self._commands:
            np.copyto(corrupt, step.act(torque, self._limits, active), where=active.joints)
            self._effects[active.place] = True
        return corrupt
