"""Curves: the arm's joints against their set points and limits, and the numbers of any message."""

from __future__ import annotations

from math import prod

import mujoco
import numpy as np

from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.levels.robot.cell import Cell
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import COMMANDED, LIMIT, of_joint, style_curves, write_legend

SIGNALS = "signals"
MAX_CURVES = 16
"""Fields with more numbers than this are tables, not curves; they are in signals/."""
JOINTS = "joints"
ERROR = "tracking_error"
GRIPPER = "gripper"
OPENING = "opening"
GRIP = "force"
QUANTITIES = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
"""Curves of a joint and their units; the torque is the one applied, after the limit gate."""
FIELDS = {
    "position": ("target", "position"),
    "velocity": ("target_velocity", "velocity"),
    "torque": ("torque",),
}
"""Fields of the curves: commanded, where it is, and measured."""


class Joints:
    """Writes the status of what drives the arm: measured and commanded, limits, tracking error and
    gripper."""

    def __init__(
        self, stream: Stream, names: tuple[str, ...], cell: Cell, has_gripper: bool
    ) -> None:
        self._stream = stream
        self._names = names
        self._has_gripper = has_gripper
        bounds = cell.bounds
        self._limits = {
            "position": np.where(np.isfinite(bounds.position), bounds.position, np.nan),
            "velocity": np.column_stack((-bounds.velocity, bounds.velocity)),
            "torque": np.column_stack((-bounds.torque, bounds.torque)),
        }
        colours = [of_joint(at) for at in range(len(names))]
        write_legend(stream, JOINTS, names, colours)
        for at, name in enumerate(names):
            for quantity, unit in QUANTITIES.items():
                entity = (JOINTS, name, quantity)
                limits = ["lower limit", "upper limit"]
                style_curves(stream, (*entity, "limits"), limits, [LIMIT, LIMIT], [1.0, 1.0])
                if quantity == "torque":
                    style_curves(stream, entity, [f"{name} applied, {unit}"], [of_joint(at)])
                else:
                    both = [f"{name} commanded, {unit}", f"{name} measured, {unit}"]
                    # The lower one is wider: it shows on both sides where the two agree.
                    style_curves(stream, entity, both, [COMMANDED, of_joint(at)], [2.5, 1.0])
        labels = [f"{name}, mrad" for name in names]
        style_curves(stream, (ERROR,), labels, colours)
        if cell.gripper is not None and has_gripper:
            for name, unit in zip((OPENING, GRIP), gripper_units(cell), strict=True):
                style_curves(stream, (GRIPPER, name), [f"{name}, {unit}"])

    def write(self, block: RowBlock) -> None:
        """Write every cycle of that level."""
        messages = block.messages
        times = block.times
        # A straight line needs only its ends.
        ends = block.times_of([0, -1])
        for quantity, fields in FIELDS.items():
            curves = np.stack([messages[field] for field in fields], axis=-1)
            limits = self._limits[quantity]
            for at, name in enumerate(self._names):
                entity = (JOINTS, name, quantity)
                self._stream.scalars(entity, times, curves[:, at])
                self._stream.scalars((*entity, "limits"), ends, np.tile(limits[at], (2, 1)))
        self._stream.scalars((ERROR,), times, (messages["position"] - messages["target"]) * 1e3)
        if self._has_gripper:
            self._stream.scalars((GRIPPER, OPENING), times, messages["opening"] * 1e3)
            self._stream.scalars((GRIPPER, GRIP), times, messages["grip_force"])


def gripper_units(cell: Cell) -> tuple[str, str]:
    """Return the units of the gripper's opening and of its force."""
    assert cell.gripper is not None, "there is a gripper"
    joint = cell.model.dof_jntid[cell.gripper.dof]
    turns = cell.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    return ("mrad", "N m") if turns else ("mm", "N")


class Fields:
    """Writes every numeric field of a mailbox: a user's own messages show without any
    configuration."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        self._stream = stream
        self._fields = [field for field in mailbox.fields if is_curve(field)]
        self._lanes = {field.name: (SIGNALS, mailbox.name, field.name) for field in self._fields}
        for field in self._fields:
            unit = "" if field.unit in ("", "1") else f", {field.unit}"
            places = [f"[{at}]" for at in range(prod(field.shape))] if field.shape else [""]
            curves = [f"{mailbox.name}.{field.name}{place}{unit}" for place in places]
            style_curves(stream, self._lanes[field.name], curves)

    def write(self, block: RowBlock) -> None:
        """Write all rows."""
        for field in self._fields:
            values = block.messages[field.name].astype(float)
            self._stream.scalars(
                self._lanes[field.name], block.times, values.reshape(len(values), -1)
            )


def is_curve(field: FieldSpec) -> bool:
    """Return whether a field can be shown as curves."""
    return not field.fields and field.kind[1] in "iufb" and 0 < prod(field.shape) <= MAX_CURVES
