"""What a level of hybrid control makes of a `COMPLIANCE` and of the contact: axes of force, guards,
reasons to rest."""

from __future__ import annotations

import mujoco
import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array, Mask, norm
from rack.levels.level import Ports, Reading
from rack.levels.operator import ABOVE_LOST
from rack.levels.systems.force.contact import AXIS_NAMES, HALVES
from rack.levels.systems.force.hybrid_law import ForceTask, turned
from rack.levels.systems.force.messages import AXES

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

    def recall(self, last: Reading) -> None:
        """Continue after a restart from the last `FORCE_STATUS`: a guard strikes once."""
        if last.is_there:
            self.struck = last.value.struck
            self.axis = last.value.axis

    def look(self, read: Ports, tick: int) -> None:
        """Judge the commands and the wrench of this cycle."""
        compliance = read.compliance.value
        wrench = read.wrench
        self.task = None
        self.rests = False
        self.reason = ""
        self.sensed = wrench.value.tick if wrench.is_there else -1
        reason = objection(compliance) if compliance.active else ""
        rotation = (
            rotation_of(compliance.frame) if compliance.frame.any() and not reason else np.eye(3)
        )
        self.felt = turned(rotation.T, wrench.value.wrench)
        if reason:
            self._rest(reason)
        elif compliance.active:
            self._follow(read, rotation, tick)

    def _follow(self, read: Ports, rotation: Array, tick: int) -> None:
        """Do what the command says, as far as the contact is known and the level above is there."""
        blind = self._blind(read.wrench, tick)
        if blind or read.command.is_lost or read.compliance.is_lost:
            self._rest(blind or ABOVE_LOST)
        self._take(read.compliance.value, rotation)
        if not blind:
            self._guard(read.compliance.value)

    def _rest(self, reason: str) -> None:
        self.rests = True
        self.reason = reason

    def _blind(self, wrench: Reading, tick: int) -> str:
        """Return why the contact is not known; empty: it is."""
        if not wrench.is_there or wrench.is_lost:
            return "no wrench from the board of the arm: waiting for it"
        if tick - self.sensed > self._oldest:
            return f"wrench is stale, {tick - self.sensed} ticks: waiting for the board of the arm"
        return "the wrist sensor is at the end of its range" if wrench.value.saturated else ""

    def _take(self, compliance: Message, rotation: Array) -> None:
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

    def _guard(self, compliance: Message) -> None:
        """End the motion once for a command whose guard is struck."""
        beyond: Mask = (compliance.guard > 0.0) & (np.abs(self.felt) > compliance.guard)
        if beyond.any() and self.struck != compliance.id:
            self.struck = compliance.id
            self.axis = int(beyond.argmax())
        if self.struck == compliance.id:
            self._rest(
                f"guard of axis {AXIS_NAMES[self.axis]} was struck: held until another command"
            )


def objection(compliance: Message) -> str:
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
