"""The executor of a level of hybrid motion/force control, between a trajectory level and boards
that servo joints.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array, Mask, norm
from rack.levels.level import Input, Inputs, LevelContext, Output, Reading
from rack.levels.operator import ABOVE_LOST
from rack.levels.robot import dynamics
from rack.levels.robot.cell import cell_of
from rack.levels.robot.dynamics import Payload
from rack.levels.servo import curves, reference
from rack.levels.servo.reference import Reference
from rack.levels.systems.force.contact import AXIS_NAMES, HALVES, WristLevel
from rack.levels.systems.force.hybrid_law import ForceTask, HybridGains, HybridLaw, turned
from rack.levels.systems.force.messages import AXES, Compliance, ForceStatus, Wrench
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from rack.levels.systems.trajectory.boards import JointBoards
from rack.levels.tables import read_params

LEAD_CYCLES = 2
"""Cycles from the release that makes a reference to the tick at which it is due: the boards below
need it in time."""
PASSED = ("opening", "force", "payload_mass", "payload_offset", "operator")
"""Fields of a reference that are handed on as they are."""
OLDEST_CYCLES = 2
"""Cycles of the level after which a wrench is too old."""


class ComplianceWatch:
    """The command in force, judged against the newest wrench in every cycle."""

    def __init__(self, most: tuple[float, float], every: int) -> None:
        """`most`: of a contact, N and N m; `every`: ticks of a cycle."""
        self._most = most
        self._oldest = OLDEST_CYCLES * every
        self.task: ForceTask | None = None  # axes of force; None: there are none
        self.struck = 0  # id of the newest command whose guard was struck
        self.axis = -1  # of that guard
        self.sensed = -1  # tick of the newest wrench; -1: none yet
        self.felt = np.zeros(AXES)  # (6,), N, N m: of the contact on the tool, in the task frame
        self.rests = False  # the motion must end
        self.reason = ""  # why, or why the force wanted is another; empty: all is as commanded

    def recall(self, last: Reading[ForceStatus]) -> None:
        """Continue after a restart from the last `ForceStatus`: a guard strikes once."""
        if last.is_there:
            self.struck = last.message.struck
            self.axis = last.message.axis

    def look(
        self,
        compliance: Reading[Compliance],
        wrench: Reading[Wrench],
        above_is_lost: bool,
        tick: int,
    ) -> None:
        """Judge the commands and the wrench of this cycle."""
        wanted = compliance.message
        self.task = None
        self.rests = False
        self.reason = ""
        self.sensed = wrench.message.tick if wrench.is_there else -1
        reason = objection(wanted) if wanted.active else ""
        rotation = rotation_of(wanted.frame) if wanted.frame.any() and not reason else np.eye(3)
        self.felt = turned(rotation.T, wrench.message.wrench)
        if reason:
            self._rest(reason)
        elif wanted.active:
            # Do what the command says, as far as the contact is known and the level above is there.
            blind = self._blind(wrench, tick)
            if blind or above_is_lost or compliance.is_lost:
                self._rest(blind or ABOVE_LOST)
            self._take(wanted, rotation)
            if not blind:
                self._guard(wanted)

    def _rest(self, reason: str) -> None:
        self.rests = True
        self.reason = reason

    def _blind(self, wrench: Reading[Wrench], tick: int) -> str:
        """Return why the contact is not known; empty: it is."""
        if not wrench.is_there or wrench.is_lost:
            return "no wrench from the board of the arm: waiting for it"
        if tick - self.sensed > self._oldest:
            return f"wrench is stale, {tick - self.sensed} ticks: waiting for the board of the arm"
        return "the wrist sensor is at the end of its range" if wrench.message.saturated else ""

    def _take(self, compliance: Compliance, rotation: Array) -> None:
        """Take over the axes of force; those forces are not sought while the motion must end."""
        selected = compliance.selected.astype(bool)
        if selected.any():
            wanted = self._permitted(np.where(selected, compliance.wrench, 0.0))
            exerted = None if self.rests else -self.felt
            self.task = ForceTask(rotation, selected, wanted, exerted, compliance.speed)

    def _permitted(self, wanted: Array) -> Array:
        """Return the force wanted, within the limits of the arm on contacts."""
        for (half, what, unit), most in zip(HALVES, self._most, strict=True):
            size = norm(wanted[half])
            if size > most:
                wanted[half] *= most / size
                text = (
                    f"{what} of {size:.3g} {unit} is wanted, {most:g} applied: the arm's limit on"
                    " contacts"
                )
                self.reason = self.reason or text
        return wanted

    def _guard(self, compliance: Compliance) -> None:
        """End the motion once for a command whose guard is struck."""
        beyond: Mask = (compliance.guard > 0.0) & (np.abs(self.felt) > compliance.guard)
        if beyond.any() and self.struck != compliance.id:
            self.struck = compliance.id
            self.axis = int(beyond.argmax())
        if self.struck == compliance.id:
            self._rest(
                f"guard of axis {AXIS_NAMES[self.axis]} was struck: held until another command"
            )


def objection(compliance: Compliance) -> str:
    """Return why a command is impossible; empty: it is not."""
    numbers = np.concatenate(
        (compliance.frame, compliance.wrench, compliance.speed, compliance.guard)
    )
    if np.isfinite(numbers).all() and compliance.frame.any():
        return ""
    return (
        f"compliance {compliance.id} rejected: a number is not finite, or the frame's quaternion is"
        " zero"
    )


def rotation_of(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion of any length but 0."""
    unit = quaternion.copy()
    rotation = np.zeros(9)
    mujoco.mju_normalize4(unit)
    mujoco.mju_quat2Mat(rotation, unit)
    return rotation.reshape(3, 3)


class HybridExecutor(WristLevel):
    """Hands the references of the level above on, later by `LEAD_CYCLES`; on axes of force it moves
    for the force.

    A guard that is struck ends the motion: the arm ramps to rest and holds until the level above
    has another command; axes of force keep their forces. Without a fresh wrench, or while the level
    above is lost, all axes rest.

    References after that, after the brakes, and after a restart of this board, begin where `status`
    says that the arm is held. References that go on when axes cease to be of force are followed at
    the distance that force has left.
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
    preloads = (curves, dynamics, reference)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = cell_of(context)
        assert cell.wrist is not None, "`misfits` refuses an arm without a sensor"
        self._watch = ComplianceWatch(cell.wrist.most, context.every)
        self._law = HybridLaw(cell, read_params(HybridGains, context.params))
        self._reference = Reference(cell.bounds, cell.limits, context.tick_s)
        self._boards = JointBoards(context.robot.joints, cell.bounds.position)
        self._target: Array = cell.home.copy()  # (joints,), rad: commanded last
        # (joints,), rad/s: of the motion alone, without that for forces.
        self._moving = np.zeros(len(cell.home))
        self._still = np.zeros(len(cell.home))
        self._tick: int | None = None  # of the last cycle

    def process(self, tick: int) -> None:
        """Follow references and forces; report."""
        if self._tick is None:
            self._watch.recall(self.last_force)
            self._tick = tick - self.context.every
        passed_s = (tick - self._tick) * self.context.tick_s
        self._tick = tick
        if self._boards.update(self.statuses):
            self._begin(self._boards.position, tick)
        if self.above.is_new:
            self._reference.take(self.above.message)
        self._watch.look(self.compliance, self.wrench, self.above.is_lost, tick)
        self.command.id = tick // self.context.every + 1
        for name in PASSED:
            setattr(self.command, name, getattr(self.above.message, name))
        if self._boards.in_step:
            self._move(self.command, tick, passed_s)
        else:
            self.command.due = 0
            self._moving[:] = 0.0
        self._report(self.status)
        force = self.force
        watch = self._watch
        force.echo = self.compliance.message.id
        force.operator = self.compliance.message.operator
        force.sensed = watch.sensed
        force.wrench = watch.felt
        force.offset = self._law.offset
        force.struck = watch.struck
        force.axis = watch.axis
        force.wanted = np.zeros(AXES) if watch.task is None else watch.task.wanted
        force.selected = np.zeros(AXES) if watch.task is None else watch.task.selected
        resting = State.IDLE if watch.task is None else State.EXECUTING
        force.state = State.HOLDING if watch.reason else resting
        force.reason = watch.reason

    def _begin(self, position: Array, tick: int) -> None:
        """Begin at rest, without a difference from the motion."""
        self._law.begin()
        self._target = position.copy()
        self._reference.start(position, self._still, tick)

    def _move(self, command: JointReference, tick: int, passed_s: float) -> None:
        """Write the reference of two cycles later."""
        watch = self._watch
        reference = self._reference
        motion = reference.rest(tick) if watch.rests else reference.at(tick)
        payload = Payload(command.payload_mass, command.payload_offset)
        joints = self._law.step(motion, watch.task, passed_s, payload)
        command.due = tick + LEAD_CYCLES * self.context.every
        for name, values in joints._asdict().items():
            setattr(command, name, values)
        self._target = joints.position
        self._moving[:] = motion.velocity
        if reference.holding and watch.task is None and self._law.rests and not self._moving.any():
            self._begin(self._target, tick)

    def _report(self, status: JointStatus) -> None:
        """Show the boards below as one, whose set points are those of this level."""
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
        kept = self._watch.reason if self._boards.in_step else self._boards.awaited
        status.error = worst.error
        status.reason = worst.reason if worst.error else kept
        if worst.error:
            status.state = State.ERROR
        elif kept:
            status.state = State.HOLDING
        else:
            status.state = State.IDLE if self._reference.holding else State.EXECUTING
