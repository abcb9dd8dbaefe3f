"""The arm's joints as curves: commanded against measured, with their limits, and the tracking error."""

from __future__ import annotations

import numpy as np
import rerun as rr

from rack.levels.robot.cell import Cell
from rack.tools.viewer.blocks import Block
from rack.tools.viewer.palette import COMMANDED, LIMIT, of_joint
from rack.tools.viewer.stream import Stream

JOINTS, ERROR, GRIPPER = "joints", "tracking_error", "gripper"
QUANTITIES = {"position": "rad", "velocity": "rad/s", "torque": "N m"}
"""Curves of a joint and their units; a torque is what the arm was given, behind the limit gate."""
_COMMANDED = {"position": "target", "velocity": "target_velocity"}


class Joints:
    """Writes `SERVO_STATUS`es."""

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

    def write(self, block: Block) -> None:
        """Write every cycle of the servo level."""
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

    def _write_limits(self, block: Block) -> None:
        # A straight line needs its ends alone.
        ends = [0, -1]
        times = self._stream.times.columns(block.ticks[ends], block.stamps_ns[ends])
        for quantity, limits in self._limits.items():
            for at, name in enumerate(self._names):
                self._stream.scalars((JOINTS, name, quantity, "limits"), times, np.tile(limits[at], (2, 1)))


def _style(name: str, at: int, quantity: str, unit: str) -> rr.SeriesLines:
    if quantity not in _COMMANDED:
        return rr.SeriesLines(names=[f"{name} given, {unit}"], colors=[of_joint(at)])
    names = [f"{name} commanded, {unit}", f"{name} measured, {unit}"]
    # The one below is the wider: it shows on both sides where the two agree.
    return rr.SeriesLines(names=names, colors=[COMMANDED, of_joint(at)], widths=[2.5, 1.0])
