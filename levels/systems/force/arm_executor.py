"""The executor of a board of an arm with a wrist sensor, which measures and limits contacts.

A sample of the sensor contains the contact, and the weight and inertia of everything attached to
the flange. The last two follow from the model: it evaluates the same sensor in the same motion
without any contact. So no mass is entered twice, and a tool with joints needs no special case.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, norm
from rack.levels.errors import LevelError
from rack.levels.level import Finding, Input, LevelContext, Output
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Terms
from rack.levels.servo.control import ArmParams, Reacting
from rack.levels.servo.stopping import Cause, Reaction
from rack.levels.systems.force.contact import HALVES, WristLevel
from rack.levels.systems.force.hybrid_law import rotate_halves
from rack.levels.systems.force.messages import AXES, Wrench
from rack.levels.systems.joint_boards import ArmExecutor

ALARMS = (Alarm.FORCE_LIMIT, Alarm.MOMENT_LIMIT)
"""Alarms by half of a wrench."""
BY_AXIS = [0, 3, 1, 4, 2, 5]
"""Order in which the torques of the components of a wrench are added up."""


def compute_contact(
    cell: Cell, dynamics: Dynamics, raw: Array, state: Array, acceleration: Array
) -> tuple[Array, Array]:
    """Compute the wrench of a contact from a sample of the wrist sensor and the arm's motion.

    Args:
        cell: Model of the arm.
        dynamics: Equation of motion of the arm, which may already be evaluated at the same state.
        raw: Sample in the frame of the sensor, (6,), N, N m.
        state: Sensed positions and velocities, (2, joints), rad, rad/s.
        acceleration: Accelerations, (joints,), rad/s2.

    Returns:
        Wrench on the tool, at the tool, in the world frame, (6,), N, N m, and its torques on the
        joints, (joints,), N m.
    """
    assert cell.wrist is not None, "`find_mismatches` refuses an arm without a sensor"
    site = cell.wrist.site
    dynamics.terms(*state)
    model, data = dynamics.evaluated
    data.qacc[cell.dof] = acceleration
    mujoco.mj_rnePostConstraint(model, data)
    body = model.site_bodyid[site]
    place = data.site_xpos[site]
    # MuJoCo stores torque before force, about the centre of mass of the body's tree.
    inner = data.cfrc_int[body]
    expected = np.concatenate((inner[3:], inner[:3]))
    moment = np.zeros(3)
    mujoco.mju_cross(moment, place - data.subtree_com[model.body_rootid[body]], expected[:3])
    expected[3:] -= moment
    wrench = expected - rotate_halves(data.site_xmat[site].reshape(3, 3), raw)
    mujoco.mju_cross(moment, place - data.site_xpos[cell.tool], wrench[:3])
    wrench[3:] += moment
    jacobian = np.zeros((AXES, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], cell.tool)
    torques = jacobian[:, cell.dof] * wrench[:, None]
    return wrench, torques[BY_AXIS].sum(axis=0)


class ForceArmParams(ArmParams):
    """`[board.<name>.params]`: the arm, and its reactions to faults and strong contacts."""

    on_force_limit: Reacting = "brake"
    """reaction to a contact beyond the limits: ramp to rest and hold, or ramp and brake, or
    brake"""


class ForceArmExecutor(WristLevel, ArmExecutor):
    """Writes the contact wrench in every cycle, and stops the arm when it is too strong.

    The limits are `most_force` and `most_torque` in `[robot.wrist]`. A contact beyond them stops
    the arm until `retry` after the contact has ended. After `patience` the fault is latched, as
    other faults are. A braked arm springs back a little, whereas an arm that holds keeps pressing.
    A sensor at the end of its range counts as beyond the limits, because the contact is unknown. A
    held object counts as contact.

    Weight and inertia of the tool are subtracted. The acceleration for this comes from the
    velocities of the joints or, with coarse encoders, from the set points. Without the subtraction,
    a tool of 1.1 kg at the acceleration limits would show up as 7 N. With velocities at 1 kHz, an
    error of 0.2 N remains. With set points it is at most 2.3 N, where dry friction changes sign,
    and 2.6 N with encoders of 1 mrad. The velocities of such encoders would cause 10 N of noise.
    """

    felt = Input(Wrench, "own.wrench")
    wrench = Output(Wrench)
    params = ForceArmParams
    settings: ForceArmParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        assert self.cell.wrist is not None, "`find_mismatches` refuses an arm without a sensor"
        self._contact_limits = self.cell.wrist.contact_limits
        self._on_limit = Reaction[self.settings.on_force_limit.upper()]
        self._range = np.repeat(self.cell.wrist.range, 3)
        self._contact_torque: Array = np.zeros(len(self.cell.dof))
        self._exact = self.cell.encoders.is_exact
        # (joints,), rad/s: velocities of the last sample.
        self._before = np.zeros(len(self.cell.dof))
        self._since: int | None = None  # tick of that sample, None if there is none
        self._exceeded = 0  # number of cycles in which the contact was beyond the limits

    def self_test(self) -> None:
        """Check that the class of the arm has a wrist sensor.

        Raises:
            LevelError: The class has no wrist sensor.
        """
        if self.arm.sense_wrist() is None:
            raise LevelError(
                f"params.arm: class '{type(self.arm).__name__}' gives no sample of a wrist sensor"
            )

    def process(self, tick: int) -> None:
        """Run the cycle of an arm, and write the wrench of the contact."""
        if self._since is None and self.felt.has_message:
            self._exceeded = self.felt.message.exceeded
        super().process(tick)
        self.wrench.tick = tick
        self.wrench.exceeded = self._exceeded

    def sense_contact(self, tick: int) -> None:
        """Sense the contact, and stop the arm if it is too strong."""
        raw = self.arm.sense_wrist()
        velocity = self._velocity
        assert raw is not None, "the self-test refuses an arm without a sensor"
        acceleration = np.zeros(len(velocity))
        is_velocity_known = not self.sensors.faulty and (self._exact or not self.abandoned)
        if is_velocity_known and self._since is not None:
            acceleration = (velocity - self._before) / (self.context.tick_s * (tick - self._since))
        wrench = self.wrench
        wrench.sample = raw
        # The comparison is written so that NaN counts as saturated.
        wrench.saturated = not (np.abs(raw) < self._range).all()
        if np.isfinite(raw).all():
            wrench.wrench, self._contact_torque = compute_contact(
                self.cell, self.arm.dynamics, raw, self.sensors.state, acceleration
            )
        self._before[:] = velocity
        self._since = tick
        self._check_limits(tick)

    @property
    def _velocity(self) -> Array:
        """Velocities from which the acceleration is computed, (joints,), rad/s."""
        velocity: Array = self.sensors.velocity if self._exact else self._wanted[1]
        return velocity

    def _check_limits(self, tick: int) -> None:
        """Stop the arm if the contact exceeds a limit, or if the sensor is saturated."""
        contact = self.wrench
        if contact.saturated:
            finding = Finding(Alarm.FORCE_LIMIT, -1, norm(contact.sample[:3]))
            text = "contact too strong: the wrist sensor is at the end of its range"
            self._stop_arm(finding, text, tick)
            return
        for (half, name, unit), limit, alarm in zip(
            HALVES, self._contact_limits, ALARMS, strict=True
        ):
            strength = norm(contact.wrench[half])
            if strength > limit:
                text = f"contact too strong: {name} of {strength:.3g} {unit}; permitted: {limit:g}"
                self._stop_arm(Finding(alarm, -1, strength), text, tick)
                return

    def _stop_arm(self, finding: Finding, text: str, tick: int) -> None:
        """Register a contact as the cause of a stop, and count the cycle.

        Args:
            finding: Finding to report.
            text: Description of the contact.
            tick: Tick of the cycle.
        """
        self._exceeded += 1
        cause = Cause(Error.FORCE, text, value=finding.value)
        self.stopping.register_blow(cause, finding, tick, self._on_limit)

    def on_restored(self) -> None:
        """Store the restored velocities, from which the next acceleration is computed."""
        self._before[:] = self._velocity
        self._since = self.arm.tick

    def find_terms(self) -> Terms:
        """Return the equation of motion at the sensed state, with payload and contact."""
        terms = super().find_terms()
        terms.bias[:] -= self._contact_torque
        return terms
