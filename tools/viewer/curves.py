"""Curves: the arm's joints against their set points and limits, and the numbers of any message."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from math import prod

import mujoco
import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell
from rack.tools.viewer.stream import RowBlock, Stream, ViewPart
from rack.tools.viewer.style import (
    COMMANDED,
    LIMIT,
    OVERLAID,
    curves,
    of_joints,
    style_curves,
    write_legend,
)

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
    "position": {"commanded": "target", "measured": "position"},
    "velocity": {"commanded": "target_velocity", "measured": "velocity"},
    "torque": {"applied": "torque"},
}
"""Fields of the curves of a joint, by what they show."""


def joint_curves(
    stream: Stream, names: Sequence[str], cell: Cell, has_gripper: bool
) -> Iterator[ViewPart]:
    """Yield the parts that write the status of what drives the arm: each joint as measured and as
    commanded, with its limits, tracking error and gripper.
    """
    colours = of_joints(len(names))
    write_legend(stream, JOINTS, names, colours)
    bounds = cell.bounds
    limits = {
        "position": np.where(np.isfinite(bounds.position), bounds.position, np.nan),
        "velocity": np.column_stack((-bounds.velocity, bounds.velocity)),
        "torque": np.column_stack((-bounds.torque, bounds.torque)),
    }
    for at, name in enumerate(names):
        for quantity, fields in FIELDS.items():
            entity = (JOINTS, name, quantity)
            yield _limits(stream, (*entity, "limits"), limits[quantity][at])
            labels = [f"{name} {how}, {QUANTITIES[quantity]}" for how in fields]
            values = partial(_of_joint, at, tuple(fields.values()))
            if len(fields) == 1:
                yield curves(stream, entity, values, labels, [colours[at]])
            else:
                both = [COMMANDED, colours[at]]
                yield curves(stream, entity, values, labels, both, OVERLAID)
    labels = [f"{name}, mrad" for name in names]
    yield curves(
        stream,
        (ERROR,),
        lambda block: (block.messages["position"] - block.messages["target"]) * 1e3,
        labels,
        colours,
    )
    if cell.gripper is not None and has_gripper:
        opening, grip = gripper_units(cell)
        yield curves(
            stream,
            (GRIPPER, OPENING),
            lambda block: block.messages["opening"] * 1e3,
            [f"{OPENING}, {opening}"],
        )
        yield curves(
            stream,
            (GRIPPER, GRIP),
            lambda block: block.messages["grip_force"],
            [f"{GRIP}, {grip}"],
        )


def _limits(stream: Stream, entity: Sequence[str], limits: Array) -> ViewPart:
    """Return the part that writes the limits of a quantity, (2,): straight lines need only their
    ends.
    """
    style_curves(stream, entity, ["lower limit", "upper limit"], [LIMIT, LIMIT], [1.0, 1.0])
    return lambda block: stream.scalars(entity, block.times_of([0, -1]), np.tile(limits, (2, 1)))


def _of_joint(at: int, fields: Sequence[str], block: RowBlock) -> Array:
    return np.stack([block.messages[field][:, at] for field in fields], axis=-1)


def gripper_units(cell: Cell) -> tuple[str, str]:
    """Return the units of the gripper's opening and of its force."""
    assert cell.gripper is not None, "there is a gripper"
    joint = cell.model.dof_jntid[cell.gripper.dof]
    turns = cell.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    return ("mrad", "N m") if turns else ("mm", "N")


def field_curves(stream: Stream, mailbox: MailboxSpec) -> Iterator[ViewPart]:
    """Yield the parts that write the numeric fields of a mailbox: a user's own messages show
    without any configuration.
    """
    for field in mailbox.fields:
        if field.fields or field.kind[1] not in "iufb" or not 0 < prod(field.shape) <= MAX_CURVES:
            continue
        unit = "" if field.unit in ("", "1") else f", {field.unit}"
        places = [f"[{at}]" for at in range(prod(field.shape))] if field.shape else [""]
        names = [f"{mailbox.name}.{field.name}{place}{unit}" for place in places]
        entity = (SIGNALS, mailbox.name, field.name)
        yield curves(stream, entity, partial(_numbers, field.name), names)


def _numbers(field: str, block: RowBlock) -> Array:
    return np.asarray(block.messages[field], float).reshape(len(block.rows), -1)
