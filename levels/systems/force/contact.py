"""The contact that requests have asked for, and the base of levels that need a wrist sensor.

A contact determines which axes of a task frame are axes of force, and which wrenches end a motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np

from rack.levels.algebra import Array, Mask, norm
from rack.levels.level import Executor, LevelContext, Mismatches
from rack.levels.systems.force.messages import Compliance

Axis = Literal["x", "y", "z", "rx", "ry", "rz"]
AXIS_NAMES: tuple[Axis, ...] = get_args(Axis)
"""Names of the axes of a task frame: along x, y, z, then about them."""
UNITS = ("N", "N", "N", "N m", "N m", "N m")
HALVES = ((slice(0, 3), "force", "N"), (slice(3, 6), "torque", "N m"))
"""The halves of a wrench: slice, name and unit."""
MAX_UNIT_ERROR = 1e-3
"""Largest permitted deviation of the length of a quaternion from 1."""
SAME = 1e-9
"""Largest difference between quaternions that count as the same."""


class WantedContact(NamedTuple):
    """The contact that a request asks for; see `ServerRequest`.

    All fields but `frame` have one value per axis, (6,).
    """

    frame: Array  # (4,)
    selected: Mask
    wrench: Array
    speed: Array
    guard: Array

    @classmethod
    def from_record(cls, record: Any) -> Self:
        """Read the contact from the record of a request."""
        wanted = cls(*(record[name] for name in cls._fields))
        return wanted._replace(selected=wanted.selected.astype(bool))


class Contact(Compliance):
    """The contact that a server commands, as the `Compliance` message that it sends.

    On an axis of force the wrench is controlled, on an axis of motion the arm follows the motion.
    `id` increases with every change.
    """

    @property
    def is_compliant(self) -> bool:
        """True if any axis is an axis of force."""
        return bool(self.selected.any())

    def set_force_axes(self, wanted: WantedContact) -> bool:
        """Replace the axes of force. If the task frame changes, remove the guards too.

        Args:
            wanted: Contact with the new axes.

        Returns:
            True if the motion must restart from rest.
        """
        selected = wanted.selected
        is_other_frame = not self._is_same_frame(wanted.frame)
        must_restart = self.is_compliant and (
            is_other_frame or bool((self.selected != selected).any())
        )
        if is_other_frame:
            self.guard[:] = 0.0
        self.id += 1
        self.frame[:] = wanted.frame / norm(wanted.frame)
        self.selected[:] = selected
        self.speed[:] = wanted.speed
        self.wrench[:] = np.where(selected, wanted.wrench, 0.0)
        return must_restart

    def set_guards(self, frame: Array, guard: Array) -> None:
        """Replace the task frame and the guards."""
        self.id += 1
        self.frame[:] = frame / norm(frame)
        self.guard[:] = guard

    def clear_wrench(self) -> None:
        """Set the wanted forces to zero without changing the axes of force."""
        self.id += 1
        self.wrench[:] = 0.0

    def release_axes(self) -> None:
        """Turn all axes into axes of motion, and remove all guards."""
        self.id += 1
        self.selected[:] = False
        self.wrench[:] = 0.0
        self.guard[:] = 0.0

    def find_guard_error(self, frame: Array, guard: Array) -> str:
        """Return the reason why guards cannot be set at present, or an empty string.

        While there are axes of force, guards must be given in the same task frame.
        """
        if self.is_compliant and guard.any() and not self._is_same_frame(frame):
            return (
                "the guard's frame is not that of the axes of force; permitted while complying: the"
                " same"
            )
        return ""

    def _is_same_frame(self, frame: Array) -> bool:
        """Return True if `frame` equals the present task frame. q and -q count as equal."""
        return bool(1.0 - abs(float((frame * self.frame).sum())) / norm(frame) < SAME)


def check_frame_and_wrenches(
    frame: Array, vectors: Sequence[Array], most: tuple[float, float]
) -> str:
    """Check a task frame and the wrenches given in it. Return what is invalid, or an empty string.

    Args:
        frame: Orientation of the frame, as w, x, y, z. Its length must be 1.
        vectors: Wrenches, (6,) each.
        most: Largest permitted force, N, and torque, N m, of a contact.
    """
    # The comparison is written so that NaN is rejected.
    if not abs(norm(frame) - 1.0) <= MAX_UNIT_ERROR:
        return f"the task frame's quaternion has length {norm(frame):.3g}; permitted: 1"
    for wrench in vectors:
        for (half, name, unit), limit in zip(HALVES, most, strict=True):
            if not norm(wrench[half]) <= limit:
                return (
                    f"{name} {norm(wrench[half]):g} {unit}; permitted by the arm and its sensor:"
                    f" {limit:g}"
                )
    return ""


class WristLevel(Executor):
    """Base of executors for arms with a wrist sensor."""

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield the mismatches of the base class, and one if the arm has no wrist sensor."""
        yield from super().find_mismatches(context)
        if context.robot.wrist is None:
            yield (
                "executor",
                cls.__name__,
                "it needs a wrist sensor: give the arm a table [robot.wrist]",
            )
