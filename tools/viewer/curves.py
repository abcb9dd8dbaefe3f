"""Curves: the arm's joints against their set points and limits, and the numbers of any message."""

from __future__ import annotations

from math import prod

import numpy as np
import rerun as rr

from rack.backplane.layout import FieldSpec, MailboxSpec
from rack.levels.robot.cell import Cell
from rack.tools.viewer.stream import RowBlock, Stream
from rack.tools.viewer.style import COMMANDED, LIMIT, of_joint

SIGNALS = "signals"
MAX_CURVES = 16
"""Fields with more numbers than this are tables, not curves; they are in signals.parquet."""
JOINTS, ERROR, GRIPPER = "joints", "tracking_error", "gripper"
QUANTITIES = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
"""Curves of a joint and their units; the torque is the one applied, after the limit gate."""
_COMMANDED = {"position": "target", "velocity": "target_velocity"}


class Joints:
    """Writes the status of what drives the arm: measured and commanded, limits, tracking error and gripper."""

    def __init__(self, stream: Stream, names: tuple[str, ...], cell: Cell, has_gripper: bool) -> None:
        self._stream, self._names, self._has_gripper = stream, names, has_gripper
        bounds = cell.bounds
        self._limits = {
            "position": np.where(np.isfinite(bounds.position), bounds.position, np.nan),
            "velocity": np.column_stack((-bounds.velocity, bounds.velocity)),
            "torque": np.column_stack((-bounds.torque, bounds.torque)),
        }
        for at, name in enumerate(names):
            for quantity, unit in QUANTITIES.items():
                stream.static((JOINTS, name, quantity), _style(name, at, quantity, unit))
                lines = rr.SeriesLines(names=["lower limit", "upper limit"], colors=[LIMIT, LIMIT], widths=[1.0, 1.0])
                stream.static((JOINTS, name, quantity, "limits"), lines)
        labels = [f"{name}, mrad" for name in names]
        stream.static((ERROR,), rr.SeriesLines(names=labels, colors=[of_joint(at) for at in range(len(names))]))
        if has_gripper:
            stream.static((GRIPPER, "opening"), rr.SeriesLines(names=["opening, mm"]))
            stream.static((GRIPPER, "force"), rr.SeriesLines(names=["force, N"]))

    def write(self, block: RowBlock) -> None:
        """Write every cycle of that level."""
        messages, times = block.messages, block.times
        for quantity in QUANTITIES:
            measured = messages[quantity]
            commanded = messages[_COMMANDED[quantity]] if quantity in _COMMANDED else None
            for at, name in enumerate(self._names):
                curves = measured[:, at] if commanded is None else np.column_stack((commanded[:, at], measured[:, at]))
                self._stream.scalars((JOINTS, name, quantity), times, curves)
        self._write_limits(block)
        self._stream.scalars((ERROR,), times, (messages["position"] - messages["target"]) * 1e3)
        if self._has_gripper:
            self._stream.scalars((GRIPPER, "opening"), times, messages["opening"] * 1e3)
            self._stream.scalars((GRIPPER, "force"), times, messages["grip_force"])

    def _write_limits(self, block: RowBlock) -> None:
        # A straight line needs only its ends.
        ends = [0, -1]
        times = self._stream.times.columns(block.ticks[ends], block.stamps_ns[ends])
        for quantity, limits in self._limits.items():
            for at, name in enumerate(self._names):
                self._stream.scalars((JOINTS, name, quantity, "limits"), times, np.tile(limits[at], (2, 1)))


def _style(name: str, at: int, quantity: str, unit: str) -> rr.SeriesLines:
    if quantity not in _COMMANDED:
        return rr.SeriesLines(names=[f"{name} applied, {unit}"], colors=[of_joint(at)])
    names = [f"{name} commanded, {unit}", f"{name} measured, {unit}"]
    # The lower one is wider: it shows on both sides where the two agree.
    return rr.SeriesLines(names=names, colors=[COMMANDED, of_joint(at)], widths=[2.5, 1.0])


class Fields:
    """Writes every numeric field of a mailbox: a user's own messages show without any configuration."""

    def __init__(self, stream: Stream, mailbox: MailboxSpec) -> None:
        self._stream = stream
        self._fields = [field for field in mailbox.fields if is_curve(field)]
        self._lanes = {field.name: (SIGNALS, mailbox.name, field.name) for field in self._fields}
        for field in self._fields:
            unit = "" if field.unit in ("", "1") else f", {field.unit}"
            places = [f"[{at}]" for at in range(prod(field.shape))] if field.shape else [""]
            curves = [f"{mailbox.name}.{field.name}{place}{unit}" for place in places]
            stream.static(self._lanes[field.name], rr.SeriesLines(names=curves))

    def write(self, block: RowBlock) -> None:
        """Write all rows."""
        for field in self._fields:
            values = block.messages[field.name].astype(float)
            self._stream.scalars(self._lanes[field.name], block.times, values.reshape(len(values), -1))


def is_curve(field: FieldSpec) -> bool:
    """Return whether a field can be shown as curves."""
    return not field.fields and field.kind[1] in "iufb" and 0 < prod(field.shape) <= MAX_CURVES
