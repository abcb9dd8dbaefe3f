"""The contact that requests have asked for: which axes of a task frame are of force, and what ends
a motion; and the base of the levels that need a wrist sensor for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np

from rack.levels.algebra import Array, Mask, norm
from rack.levels.level import Executor, LevelContext, Misfits
from rack.levels.systems.force.messages import AXES, Compliance

Axis = Literal["x", "y", "z", "rx", "ry", "rz"]
AXIS_NAMES: tuple[Axis, ...] = get_args(Axis)
"""Axes of a task frame: along x, y, z, then about them."""
UNITS = ("N", "N", "N", "N m", "N m", "N m")
HALVES = ((slice(0, 3), "force", "N"), (slice(3, 6), "torque", "N m"))
"""The halves of a wrench."""
MAX_UNIT_ERROR = 1e-3
"""A quaternion whose length is farther from 1 is no orientation."""
SAME = 1e-9
"""Largest difference between the numbers of quaternions that are the same."""


class Wanted(NamedTuple):
    """What a request asks of a contact; the last four (6,), by axis. See `ServerRequest`."""

    frame: Array  # (4,)
    selected: Mask
    wrench: Array
    speed: Array
    guard: Array

    @classmethod
    def of(cls, record: Any) -> Self:
        """Return that of the record of a request."""
        wanted = cls(*(record[name] for name in cls._fields))
        return wanted._replace(selected=wanted.selected.astype(bool))


class Contact:
    """What is in force: the content of a server's `Compliance`."""

    def __init__(self) -> None:
        self.id = 0  # rises with every change
        self.frame = np.array([1.0, 0.0, 0.0, 0.0])  # orientation of the task frame
        self.selected = np.zeros(AXES, dtype=bool)  # axes of force
        self.wrench, self.speed, self.guard = np.zeros((3, AXES))  # N, N m; m/s, rad/s; N, N m

    @property
    def complies(self) -> bool:
        """Whether any axis is one of force."""
        return bool(self.selected.any())

    def comply(self, wanted: Wanted) -> bool:
        """Replace the axes of force, and the guards if the frame is another; return whether motion
        begins anew.
        """
        selected = wanted.selected
        turned = not self._is_frame(wanted.frame)
        begins_anew = self.complies and (turned or bool((self.selected != selected).any()))
        if turned:
            self.guard[:] = 0.0
        self.id += 1
        self.frame[:] = wanted.frame / norm(wanted.frame)
        self.selected[:] = selected
        self.speed[:] = wanted.speed
        self.wrench[:] = np.where(selected, wanted.wrench, 0.0)
        return begins_anew

    def watch(self, frame: Array, guard: Array) -> None:
        """Replace the guards."""
        self.id += 1
        self.frame[:] = frame / norm(frame)
        self.guard[:] = guard

    def relax(self) -> None:
        """Want no force on the axes of force."""
        self.id += 1
        self.wrench[:] = 0.0

    def release(self) -> None:
        """Make all axes ones of motion, unguarded."""
        self.id += 1
        self.selected[:] = False
        self.wrench[:] = 0.0
        self.guard[:] = 0.0

    def objection(self, frame: Array, guard: Array) -> str:
        """Return why guards in that frame are impossible now; empty: they are not."""
        if self.complies and guard.any() and not self._is_frame(frame):
            return (
                "the guard's frame is not that of the axes of force; permitted while complying: the"
                " same"
            )
        return ""

    def _is_frame(self, frame: Array) -> bool:
        # q and -q are the same orientation.
        return bool(1.0 - abs(float((frame * self.frame).sum())) / norm(frame) < SAME)

    def fill(self, compliance: Compliance) -> None:
        """Fill a `Compliance`."""
        compliance.id = self.id
        compliance.active = self.complies or bool(self.guard.any())
        for name in Wanted._fields:
            setattr(compliance, name, getattr(self, name))

    def recall(self, compliance: Compliance) -> None:
        """Continue from the last message of a level that was restarted."""
        self.id = compliance.id
        for name in Wanted._fields:
            getattr(self, name)[:] = getattr(compliance, name)


def misfit(frame: Array, vectors: Sequence[Array], most: tuple[float, float]) -> str:
    """Return why a task frame (4,), or wrenches (6,) in it, are impossible; `most`: of a contact, N
    and N m.

    Empty: they are possible.
    """
    # Written so that NaN is outside.
    if not abs(norm(frame) - 1.0) <= MAX_UNIT_ERROR:
        return f"the task frame's quaternion has length {norm(frame):.3g}; permitted: 1"
    for wrench in vectors:
        for (half, what, unit), limit in zip(HALVES, most, strict=True):
            if not norm(wrench[half]) <= limit:
                return (
                    f"{what} {norm(wrench[half]):g} {unit}; permitted by the arm and its sensor:"
                    f" {limit:g}"
                )
    return ""


class WristLevel(Executor):
    """An executor for arms with a wrist sensor."""

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield an arm without a wrist sensor, besides what any level of the kind finds."""
        yield from super().misfits(context, above, below)
        if context.robot.wrist is None:
            yield (
                "executor",
                cls.__name__,
                "it needs a wrist sensor: give the arm a table [robot.wrist]",
            )
