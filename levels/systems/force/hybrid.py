"""The executor of a level of hybrid motion/force control.

It stands between a trajectory level and boards that servo joints.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array, Mask, norm
from rack.levels.level import Input, Inputs, LevelContext, Output, Reading
from rack.levels.operator import ABOVE_LOST
from rack.levels.robot import dynamics
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.dynamics import Payload
from rack.levels.servo import curves, reference
from rack.levels.servo.reference import Reference
from rack.levels.systems.force.contact import AXIS_NAMES, HALVES, WristLevel
from rack.levels.systems.force.hybrid_law import ForceTask, HybridGains, HybridLaw, rotate_halves
from rack.levels.systems.force.messages import AXES, Compliance, ForceStatus, Wrench
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.systems.trajectory.boards import JointBoards

LEAD_CYCLES = 2
"""Cycles from the release that computes a reference to the tick at which it is due, so that the
boards below receive it in time."""
FORWARDED_FIELDS = ("opening", "force", "payload_mass", "payload_offset", "operator")
"""Fields of a reference that are passed down unchanged."""
MAX_WRENCH_AGE_CYCLES = 2
"""Cycles of the level after which a wrench is too old."""
NO_FORCE = np.zeros((2, AXES))
"""Wanted wrench and selected axes without axes of force."""


def find_command_error(compliance: Compliance) -> str:
    """Return the reason why a command is invalid, or an empty string if it is valid."""
    numbers = np.concatenate(
        (compliance.frame, compliance.wrench, compliance.speed, compliance.guard)
    )
    if np.isfinite(numbers).all() and compliance.frame.any():
        return ""
    return (
        f"compliance {compliance.id} rejected: a number is not finite, or the frame's quaternion is"
        " zero"
    )


def compute_rotation(quaternion: Array) -> Array:
    """Return the rotation matrix, (3, 3), of a quaternion of any length but 0."""
    unit = quaternion.copy()
    rotation = np.zeros(9)
    mujoco.mju_normalize4(unit)
    mujoco.mju_quat2Mat(rotation, unit)
    return rotation.reshape(3, 3)


class HybridExecutor(WristLevel):
    """Passes the references of the level above down, and adds the motion that controls forces.

    References become due `LEAD_CYCLES` cycles later. A guard that is struck ends the motion: the
    arm ramps to rest and holds until the level above sends another command, while the forces on
    axes of force are maintained. Without a fresh wrench, or while the level above is lost, all axes
    come to rest.

    After such a stop, after braking, and after a restart of this board, references must begin where
    `status` reports that the arm is held. When axes of force become axes of motion again during a
    motion, the references are followed with the offset that force control has caused.
    """

    above = Input(JointReference, "above.command")
    compliance = Input(Compliance, "above.compliance")
    wrench = Input(Wrench, "arm.wrench")
    statuses = Inputs(JointStatus, "below.status")
    last_force = Input(ForceStatus, "own.force")
    command = Output(JointReference, rests_on=above)
    status = Output(JointStatus, rests_on=statuses)
    force = Output(ForceStatus, rests_on=wrench)
    params = HybridGains
    settings: HybridGains
    preloads = (curves, dynamics, reference)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_level_cell(context)
        assert cell.wrist is not None, "`find_mismatches` refuses an arm without a sensor"
        self._wrench_limits = cell.wrist.contact_limits
        self._task: ForceTask | None = None  # axes of force, or None if there are none
        self._must_rest = False  # the motion must end
        self._law = HybridLaw(cell, self.settings)
        self._reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self._boards = JointBoards(context.robot.joints, cell.bounds.position)
        self._target: Array = cell.home.copy()  # (joints,), rad: last position commanded
        # (joints,), rad/s: velocity of the motion, without the part for forces.
        self._moving = np.zeros(len(cell.home))
        self._still = np.zeros(len(cell.home))
        self._tick: int | None = None  # tick of the last cycle

    def process(self, tick: int) -> None:
        """Run one cycle: follow references and forces, and report."""
        force = self.force
        if self._tick is None:
            # A guard that was struck before a restart must not end the motion a second time.
            force.axis = -1
            if self.last_force.has_message:
                force.struck = self.last_force.message.struck
                force.axis = self.last_force.message.axis
            self._tick = tick - self.context.every
        passed_s = (tick - self._tick) * self.context.tick_s
        self._tick = tick
        if self._boards.update(self.statuses):
            self._begin_at_rest(self._boards.position, tick)
        if self.above.is_new:
            self._reference.take_command(self.above.message)
        self._check_contact(tick)
        self.command.id = tick // self.context.every + 1
        for name in FORWARDED_FIELDS:
            setattr(self.command, name, getattr(self.above.message, name))
        if self._boards.in_step:
            self._write_reference(self.command, tick, passed_s)
        else:
            self.command.due = 0
            self._moving[:] = 0.0
        self._write_status(self.status)
        force.echo = self.compliance.message.id
        force.operator = self.compliance.message.operator
        force.offset = self._law.offset
        task = self._task
        force.wanted, force.selected = (task.wanted, task.selected) if task else NO_FORCE
        resting = State.EXECUTING if task else State.IDLE
        force.state = State.HOLDING if force.reason else resting

    def _check_contact(self, tick: int) -> None:
        """Check the commanded contact against the newest wrench.

        `force.reason` tells why the motion must end, or why the applied force is not as wanted.
        """
        compliance = self.compliance
        wrench = self.wrench
        force = self.force
        wanted = compliance.message
        self._task = None
        self._must_rest = False
        force.sensed = wrench.message.tick if wrench.has_message else -1
        force.reason = reason = find_command_error(wanted) if wanted.active else ""
        rotation = (
            compute_rotation(wanted.frame) if wanted.frame.any() and not reason else np.eye(3)
        )
        force.wrench = rotate_halves(rotation.T, wrench.message.wrench)
        if reason:
            self._must_rest = True
        elif wanted.active:
            # Rest if the contact is not known or a level above is lost.
            blind = self._explain_missing_wrench(wrench, tick)
            if blind or self.above.is_lost or compliance.is_lost:
                self._must_rest = True
                force.reason = blind or ABOVE_LOST
            self._take_force_axes(wanted, rotation)
            if not blind:
                self._check_guards(wanted)

    def _explain_missing_wrench(self, wrench: Reading[Wrench], tick: int) -> str:
        """Return why the present contact is unknown, or an empty string if it is known."""
        if not wrench.has_message or wrench.is_lost:
            return "no wrench from the board of the arm: waiting for it"
        age = tick - self.force.sensed
        if age > MAX_WRENCH_AGE_CYCLES * self.context.every:
            return f"wrench is stale, {age} ticks: waiting for the board of the arm"
        return "the wrist sensor is at the end of its range" if wrench.message.saturated else ""

    def _take_force_axes(self, compliance: Compliance, rotation: Array) -> None:
        """Set the axes of force of a command. If the motion must end, they come to rest too.

        A wanted wrench beyond the arm's limits is reduced, for a reason in `force.reason`.

        Args:
            compliance: Command.
            rotation: Task frame in the world, (3, 3).
        """
        selected = compliance.selected.astype(bool)
        if not selected.any():
            return
        wanted = np.where(selected, compliance.wrench, 0.0)
        for (half, name, unit), limit in zip(HALVES, self._wrench_limits, strict=True):
            size = norm(wanted[half])
            if size > limit:
                wanted[half] *= limit / size
                self.force.reason = self.force.reason or (
                    f"{name} of {size:.3g} {unit} is wanted, {limit:g} applied: the arm's limit on"
                    " contacts"
                )
        exerted = None if self._must_rest else -self.force.wrench
        self._task = ForceTask(rotation, selected, wanted, exerted, compliance.speed)

    def _check_guards(self, compliance: Compliance) -> None:
        """End the motion if the wrench exceeds a guard, once for each command."""
        force = self.force
        beyond: Mask = (compliance.guard > 0.0) & (np.abs(force.wrench) > compliance.guard)
        if beyond.any() and force.struck != compliance.id:
            force.struck = compliance.id
            force.axis = int(beyond.argmax())
        if force.struck == compliance.id:
            self._must_rest = True
            axis = AXIS_NAMES[force.axis]
            force.reason = f"guard of axis {axis} was struck: held until another command"

    def _begin_at_rest(self, position: Array, tick: int) -> None:
        """Start at rest at `position`, with no offset from the references."""
        self._law.reset_offset()
        self._target = position.copy()
        self._reference.start(position, self._still, tick)

    def _write_reference(self, command: JointReference, tick: int, passed_s: float) -> None:
        """Write the reference that is due `LEAD_CYCLES` cycles later."""
        reference = self._reference
        motion = reference.ramp_to_rest(tick) if self._must_rest else reference.compute_motion(tick)
        payload = Payload(command.payload_mass, command.payload_offset)
        joints = self._law.step(motion, self._task, passed_s, payload)
        command.due = tick + LEAD_CYCLES * self.context.every
        for name, values in joints._asdict().items():
            setattr(command, name, values)
        self._target = joints.position
        self._moving[:] = motion.velocity
        if (
            reference.holding
            and self._task is None
            and self._law.is_at_rest
            and not self._moving.any()
        ):
            self._begin_at_rest(self._target, tick)

    def _write_status(self, status: JointStatus) -> None:
        """Report the boards below as one board, with the set points of this level."""
        values = [reading.message for reading in self.statuses.values()]
        status.position = values[0].position
        status.torque[:] = sum(v.torque for v in values)
        status.driven = np.any([v.driven for v in values], axis=0)
        status.target = self._target
        status.target_velocity = self._moving
        status.echo = self.above.message.id
        status.operator = max(v.operator for v in values)
        status.holding = self._reference.holding
        status.stopped = not self._boards.in_step
        status.due = self.above.message.due
        worst = max(values, key=lambda value: value.error)
        waiting = self.force.reason if self._boards.in_step else self._boards.wait_reason
        status.error = worst.error
        status.reason = worst.reason if worst.error else waiting
        if worst.error:
            status.state = State.ERROR
        elif waiting:
            status.state = State.HOLDING
        else:
            status.state = State.IDLE if self._reference.holding else State.EXECUTING
